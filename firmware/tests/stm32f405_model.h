#ifndef STM32F405_MODEL_H
#define STM32F405_MODEL_H

#include <stddef.h>
#include <stdint.h>

void model_reset(int crystal_works);
uint32_t model_read(uint32_t address);
void model_write(uint32_t address, uint32_t value);
uint32_t model_pins(int port);
int model_driver_has_been_on(void);
const char *model_start(int output, int motor_sign, uint32_t crystal_Hz, uint32_t pwm_Hz, float full_scale_N);
uint32_t model_boot_id(void);
unsigned model_erased(int sector);
void model_output(float force_N);
void model_output_off(void);
uint32_t model_output_delay_us(void);
void model_start_ticks(uint32_t rate_Hz);
void model_tick_is_over(void);
int model_stop_is_open(void);
void model_send(const uint8_t *bytes, size_t size);
void model_line_interrupt(void);
int model_receive(void);
int32_t model_encoder(const uint16_t *counters, size_t count);
int model_config_error(void);
void model_small_flash(uint32_t words);
uint32_t model_small_boot(int cut);

#endif
