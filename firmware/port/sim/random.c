#include "random.h"

#include <math.h>

uint64_t sim_random_bits(struct sim_random *random)
{
    uint64_t z = (random->state += UINT64_C(0x9E3779B97F4A7C15));
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    return z ^ (z >> 31);
}

double sim_random_uniform(struct sim_random *random, double low, double high)
{
    const double unit = (double)(sim_random_bits(random) >> 11) * 0x1p-53;
    return low + (high - low) * unit;
}

double sim_random_normal(struct sim_random *random)
{
    for (;;) {
        const double u = sim_random_uniform(random, -1.0, 1.0);
        const double v = sim_random_uniform(random, -1.0, 1.0);
        const double square = u * u + v * v;
        if (square > 0.0 && square < 1.0) {
            return u * sqrt(-2.0 * log(square) / square);
        }
    }
}
