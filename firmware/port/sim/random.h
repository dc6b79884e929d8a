/* Random numbers that depend on the seed alone: SplitMix64, and normal deviates from it by the polar method.
 * Reference: Steele, Lea and Flood (2014), "Fast splittable pseudorandom number generators". */
#ifndef SIM_RANDOM_H
#define SIM_RANDOM_H

#include <stdint.h>

struct sim_random {
    uint64_t state;
};

uint64_t sim_random_bits(struct sim_random *random);

/* Uniform in [low, high). */
double sim_random_uniform(struct sim_random *random, double low, double high);

/* Mean 0, standard deviation 1. */
double sim_random_normal(struct sim_random *random);

#endif
