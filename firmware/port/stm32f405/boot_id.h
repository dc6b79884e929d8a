/* A number that differs at every start: a counter in two sectors of flash.
 *
 * A start appends its number and the complement of it, so that a word half written when the supply failed is no number.
 * A full sector stays until the first number stands in the other one, so that an erase that is cut short loses nothing. */
#ifndef BOOT_ID_H
#define BOOT_ID_H

#include <stdbool.h>
#include <stdint.h>

struct boot_flash {
    const volatile uint32_t *sector[2];
    uint32_t words; /* in each, even */
    bool (*erase)(unsigned sector);
    bool (*program)(const volatile uint32_t *where, uint32_t value);
};

/* The number of this start, from 1 on; 0 where the flash cannot be written. */
uint32_t boot_id_next(const struct boot_flash *flash);

#endif
