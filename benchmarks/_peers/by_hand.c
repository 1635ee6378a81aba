/* What a C programmer writes for two controllers, in the interface of an export.

   `by_hand.h` has the numbers, and defines LAYERS for a network of two hidden layers or
   nothing for a gain. Both check what goes in and what comes out, as exports do. */
#include <math.h>

#include "by_hand.h"

void by_hand_init(by_hand_state *state)
{
    int i;
    for (i = 0; i < CONTROLS; i++) state->last[i] = 0;
}

#ifdef LAYERS
static void layer(int rows, int columns, const real *W, const real *b, const real *x,
                  real *z)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        real sum = b[i];
        for (j = 0; j < columns; j++) sum += W[i * columns + j] * x[j];
        z[i] = sum;
    }
}
#endif

int by_hand_step(by_hand_state *state, real t, const real *y, real *u)
{
    int i, flag = isfinite(t) ? 0 : 1;
#ifdef LAYERS
    real first[WIDTH], second[WIDTH];
#else
    int j;
#endif
    for (i = 0; i < OBSERVATIONS; i++)
        if (!isfinite(y[i])) flag = 1;
#ifdef LAYERS
    layer(WIDTH, OBSERVATIONS, W0, b0, y, first);
    for (i = 0; i < WIDTH; i++) first[i] = tanh(first[i]);
    layer(WIDTH, WIDTH, W1, b1, first, second);
    for (i = 0; i < WIDTH; i++) second[i] = tanh(second[i]);
    layer(CONTROLS, WIDTH, W2, b2, second, u);
#else
    for (i = 0; i < CONTROLS; i++) {
        real sum = 0;
        for (j = 0; j < OBSERVATIONS; j++) sum += K[i * OBSERVATIONS + j] * y[j];
        u[i] = -sum;
    }
#endif
    for (i = 0; i < CONTROLS; i++)
        if (!isfinite(u[i])) flag = 2;
    for (i = 0; i < CONTROLS; i++)
        if (flag) u[i] = state->last[i];
        else state->last[i] = u[i];
    return flag;
}

void by_hand_applied(by_hand_state *state, const real *u, real cost)
{
    (void)state;
    (void)u;
    (void)cost;
}
