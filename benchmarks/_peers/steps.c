/* Nanoseconds a step of a controller, the best of some rounds over a table of inputs. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>

#include "controller.h" /* includes NAME.h, and defines its sizes */
#include "table.h"      /* ROWS, and rows of t and y */

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(what) JOIN(NAME, what)

static double now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return 1e9 * (double)at.tv_sec + (double)at.tv_nsec;
}

int main(void)
{
    static OF(_state) state;
    OF(_real) u[CONTROL_SIZE];
    double best = 1e300, sum = 0;
    int round, times, row;
    for (round = 0; round < ROUNDS; round++) {
        double began, taken;
        OF(_init)(&state);
        began = now();
        for (times = 0; times < TIMES; times++)
            for (row = 0; row < ROWS; row++) {
                OF(_step)(&state, table[row][0], table[row] + 1, u);
                sum += u[0];
            }
        taken = (now() - began) / ((double)TIMES * ROWS);
        if (taken < best) best = taken;
    }
    printf("%.9g %.17g\n", best, sum); /* the sum, so that all is computed */
    return 0;
}
