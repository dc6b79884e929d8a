/* Stub: the contract compiles and links; what the device does comes next. */
#include "hb_device.h"

const char *hb_error_sentence(enum hb_error error) { return error == HB_OK ? "Nothing is wrong." : "Something is."; }

enum hb_error hb_config_check(const struct hb_config *config)
{
    (void)config;
    return HB_OK;
}

enum hb_error hb_init(struct hb_device *device, const struct hb_config *config, uint32_t boot_id)
{
    *device = (struct hb_device){.config = config, .boot_id = boot_id};
    return HB_OK;
}

size_t hb_receive(struct hb_device *device, const uint8_t *bytes, size_t size)
{
    (void)device;
    (void)bytes;
    return size;
}

size_t hb_transmit(struct hb_device *device, uint8_t *bytes, size_t room)
{
    (void)device;
    (void)bytes;
    (void)room;
    return 0;
}

float hb_tick(struct hb_device *device, const struct hb_input *input)
{
    (void)input;
    device->tick += 1U;
    return 0.0F;
}
