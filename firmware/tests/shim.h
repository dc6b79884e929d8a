#ifndef SHIM_H
#define SHIM_H

#include "hb_device.h"

struct shim;

size_t shim_size(void);
size_t shim_device_size(void);
int shim_init(struct shim *shim, const double *n, uint32_t boot_id);
const char *shim_sentence(int error);
void shim_receive(struct shim *shim, const uint8_t *bytes, size_t size);
size_t shim_receive_once(struct shim *shim, const uint8_t *bytes, size_t size);
size_t shim_transmit(struct shim *shim, uint8_t *bytes, size_t room);
float shim_tick(struct shim *shim, int32_t counts, int valid, int overrun, float sensed_N);
float shim_tick_of_board(struct shim *shim, int32_t counts, uint32_t delay_us, int stop_open);
double shim_delayed_damping(const double *set, const float *weight, const float *loss, uint32_t delay_us);
uint32_t shim_flags(const struct shim *shim);
double shim_offset_N(const struct shim *shim);
uint32_t shim_stops(const struct shim *shim);
int shim_state(const struct shim *shim);
uint32_t shim_now(const struct shim *shim);
uint32_t shim_warm_left(const struct shim *shim);
void shim_run(struct shim *shim, const int32_t *counts, size_t size, int beating, float *forces, uint16_t *flags);
int shim_render(const double *set, const float *weight, const float *loss, const float *x_mm, size_t size,
                float *forces);
void shim_closed_forms(const double *set, double *found);
float shim_power(uint32_t base, float exponent);
double shim_power_error(uint32_t base, float low, float high, uint32_t stride);

#endif
