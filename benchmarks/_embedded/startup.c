/* What runs before main on a Cortex-M4F, as QEMU's mps2-an386 has it. */
#include <stdint.h>
#include <stdlib.h>

extern uint32_t data_from[], data_begin[], data_end[], bss_begin[], bss_end[];
extern uint32_t stack_top[];
extern void initialise_monitor_handles(void);
extern int main(void);

#define VTOR (*(volatile uint32_t *)0xE000ED08u)
#define CPACR (*(volatile uint32_t *)0xE000ED88u)

void reset(void);

/* Newlib calls them at the end of a program. */
void _init(void) {}
void _fini(void) {}

/* A fault ends the run, so that the caller sees it. */
static void fault(void)
{
    _Exit(70);
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))(uintptr_t)stack_top, reset, fault, fault, fault, fault, fault,
    0, 0, 0, 0, fault, fault, 0, fault, fault,
};

void reset(void)
{
    uint32_t *to, *from = data_from;
    VTOR = (uint32_t)(uintptr_t)vectors;
    CPACR |= 0xFu << 20; /* the floating-point unit is off after a reset */
    __asm volatile("dsb\n isb" ::: "memory");
    for (to = data_begin; to < data_end;) *to++ = *from++;
    for (to = bss_begin; to < bss_end;) *to++ = 0;
    initialise_monitor_handles();
    exit(main());
}
