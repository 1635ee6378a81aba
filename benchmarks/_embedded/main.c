/* Runs a controller over a table of inputs, on the board and on the host alike.

   A line of output for each row: the flag, the controls as the hexadecimal digits of
   their bytes, and on the board the ticks of the step. Compiled with NAME, the name of
   the controller, and BOARD on the board. */
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "controller.h" /* includes NAME.h, and defines its sizes */
#include "table.h"      /* ROWS, and rows of t, y, the control applied and its cost */

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(what) JOIN(NAME, what)

typedef OF(_real) real;
static OF(_state) state;

#ifdef BOARD
#define CONTROL (*(volatile uint32_t *)0xE000E010u)
#define RELOAD (*(volatile uint32_t *)0xE000E014u)
#define TICKS (*(volatile uint32_t *)0xE000E018u)
#define PAINT 0xA5A5A5A5u
extern uint32_t stack_bottom[];

static uint32_t since(uint32_t before)
{
    return (before - TICKS) & 0xFFFFFFu; /* SysTick counts down */
}

/* The ticks of a million instructions: a loop of two. */
static uint32_t __attribute__((noinline)) calibrated(void)
{
    uint32_t count = 500000, before = TICKS;
    __asm volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(count) : : "cc");
    return since(before);
}

static uint32_t *stack_pointer(void)
{
    uint32_t *here;
    __asm volatile("mov %0, sp" : "=r"(here));
    return here;
}
#endif

static int step(const real *row, real *u)
{
    return OF(_step)(&state, row[0], row + 1, u);
}

/* An empty step, to know what the measurement itself takes. */
static int (*volatile measured)(const real *, real *) = step;

static int nothing(const real *row, real *u)
{
    (void)row;
    (void)u;
    return 0;
}

static void print(const real *u, int flag, unsigned long ticks)
{
    size_t i, k;
    printf("%d %lu", flag, ticks);
    for (i = 0; i < CONTROL_SIZE; i++) {
        unsigned char bytes[sizeof(real)];
        memcpy(bytes, u + i, sizeof(real));
        printf(" ");
        for (k = 0; k < sizeof(real); k++) printf("%02x", bytes[k]);
    }
    printf("\n");
}

int main(void)
{
    size_t row;
    real u[CONTROL_SIZE];
    unsigned long ticks = 0;
#ifdef BOARD
    uint32_t before, empty, *here, *deepest;
    RELOAD = 0xFFFFFFu;
    TICKS = 0;
    CONTROL = 5; /* counts the clock of the processor, without interrupts */
    measured = nothing;
    before = TICKS;
    for (row = 0; row < 1000; row++) measured(table[0], u);
    empty = since(before);
    measured = step;
    printf("calibration %lu %lu\n", (unsigned long)calibrated(), (unsigned long)empty);
    OF(_init)(&state);
    here = stack_pointer();
    for (deepest = stack_bottom; deepest < here - 16; deepest++) *deepest = PAINT;
    measured(table[0], u);
    for (deepest = stack_bottom; *deepest == PAINT;) deepest++;
    printf("stack %lu\n", (unsigned long)((char *)here - (char *)deepest));
    printf("state %lu\n", (unsigned long)sizeof(state));
#else
    (void)nothing;
#endif
    OF(_init)(&state);
    for (row = 0; row < ROWS; row++) {
        int flag;
#ifdef BOARD
        before = TICKS;
#endif
        flag = measured(table[row], u);
#ifdef BOARD
        ticks = since(before);
#endif
        print(u, flag, ticks);
        OF(_applied)(&state, table[row] + 1 + OBSERVATION_SIZE,
                     table[row][1 + OBSERVATION_SIZE + CONTROL_SIZE]);
    }
    return 0;
}
