/* The pendulum of Gymnasium, by hand: float32, structure of arrays, time first.

   A batch loops over the lanes inside the loop over time, so that the compiler turns
   the inner loop into vector code, with the vector sine of libmvec where the system
   has one. One chain has its own scalar loop. */

#include <math.h>
#include <stddef.h>
#include <string.h>

#if defined(__SSE__)
#include <xmmintrin.h>
/* XLA runs with denormal numbers flushed to zero; so does this file. */
#define FLUSH_BEGIN                        \
    const unsigned int saved = _mm_getcsr(); \
    _mm_setcsr(saved | 0x8040u)
#define FLUSH_END _mm_setcsr(saved)
#else
#define FLUSH_BEGIN
#define FLUSH_END
#endif

#define GRAVITY 10.0f
#define MASS 1.0f
#define LENGTH 1.0f
#define DT 0.05f
#define MAX_TORQUE 2.0f
#define MAX_SPEED 8.0f
#define TWO_PI 6.28318530717958647692f

static inline float clip(float x, float bound) {
    return fminf(fmaxf(x, -bound), bound);
}

static inline float wrap(float x) {
    return x - TWO_PI * rintf(x * (1.0f / TWO_PI));
}

static inline float control(float angle, float speed, float k0, float k1) {
    return clip(-(k0 * angle + k1 * speed), MAX_TORQUE);
}

static inline float stage_cost(float angle, float speed, float u) {
    const float a = wrap(angle);
    return a * a + 0.1f * speed * speed + 0.001f * u * u;
}

static inline float next_speed(float angle, float speed, float u) {
    const float acceleration = 3.0f * GRAVITY / (2.0f * LENGTH) * sinf(angle)
                               + 3.0f / (MASS * LENGTH * LENGTH) * u;
    return clip(speed + acceleration * DT, MAX_SPEED);
}

/* Controller and cost; `steps` + 1 states, `steps` controls and costs are kept. */
void trajectory_chain(size_t steps, float k0, float k1, float angle, float speed,
                      float *restrict angles, float *restrict speeds,
                      float *restrict controls, float *restrict costs) {
    FLUSH_BEGIN;
    for (size_t t = 0; t < steps; ++t) {
        const float u = control(angle, speed, k0, k1);
        angles[t] = angle;
        speeds[t] = speed;
        controls[t] = u;
        costs[t] = stage_cost(angle, speed, u);
        speed = next_speed(angle, speed, u);
        angle += speed * DT;
    }
    angles[steps] = angle;
    speeds[steps] = speed;
    FLUSH_END;
}

/* The same for a batch; outputs are [time][lanes]. */
void trajectory_batch(size_t lanes, size_t steps, float k0, float k1,
                      const float *restrict angle0, const float *restrict speed0,
                      float *angles, float *speeds, float *restrict controls,
                      float *restrict costs) {
    FLUSH_BEGIN;
    memcpy(angles, angle0, lanes * sizeof(float));
    memcpy(speeds, speed0, lanes * sizeof(float));
    for (size_t t = 0; t < steps; ++t) {
        const float *angle = angles + t * lanes;
        const float *speed = speeds + t * lanes;
        float *next_angles = angles + (t + 1) * lanes;
        float *next_speeds = speeds + (t + 1) * lanes;
        float *u_row = controls + t * lanes;
        float *cost_row = costs + t * lanes;
#pragma omp simd
        for (size_t i = 0; i < lanes; ++i) {
            const float a = angle[i];
            const float s = speed[i];
            const float u = control(a, s, k0, k1);
            const float s_next = next_speed(a, s, u);
            cost_row[i] = stage_cost(a, s, u);
            next_speeds[i] = s_next;
            next_angles[i] = a + s_next * DT;
            u_row[i] = u;
        }
    }
    FLUSH_END;
}

/* Controller and cost; only the total cost is kept. */
float cost_chain(size_t steps, float k0, float k1, float angle, float speed) {
    FLUSH_BEGIN;
    float total = 0.0f;
    for (size_t t = 0; t < steps; ++t) {
        const float u = control(angle, speed, k0, k1);
        total += stage_cost(angle, speed, u);
        speed = next_speed(angle, speed, u);
        angle += speed * DT;
    }
    FLUSH_END;
    return total;
}

/* The same for a batch. `angle` and `speed` hold the start and are overwritten by the
   final state; `total` holds zeros and receives the total costs. */
void cost_batch(size_t lanes, size_t steps, float k0, float k1, float *restrict angle,
                float *restrict speed, float *restrict total) {
    FLUSH_BEGIN;
    for (size_t t = 0; t < steps; ++t) {
#pragma omp simd
        for (size_t i = 0; i < lanes; ++i) {
            const float u = control(angle[i], speed[i], k0, k1);
            total[i] += stage_cost(angle[i], speed[i], u);
            speed[i] = next_speed(angle[i], speed[i], u);
            angle[i] += speed[i] * DT;
        }
    }
    FLUSH_END;
}

/* No controller, no cost; the state is overwritten by the final one. */
void free_chain(size_t steps, float *angle, float *speed) {
    FLUSH_BEGIN;
    float a = *angle;
    float s = *speed;
    for (size_t t = 0; t < steps; ++t) {
        s = next_speed(a, s, 0.0f);
        a += s * DT;
    }
    *angle = a;
    *speed = s;
    FLUSH_END;
}

void free_batch(size_t lanes, size_t steps, float *restrict angle,
                float *restrict speed) {
    FLUSH_BEGIN;
    for (size_t t = 0; t < steps; ++t) {
#pragma omp simd
        for (size_t i = 0; i < lanes; ++i) {
            speed[i] = next_speed(angle[i], speed[i], 0.0f);
            angle[i] += speed[i] * DT;
        }
    }
    FLUSH_END;
}
