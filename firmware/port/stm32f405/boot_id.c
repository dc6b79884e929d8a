#include "boot_id.h"

static const uint32_t BLANK = UINT32_C(0xFFFFFFFF);

static bool is_number(const volatile uint32_t *pair)
{
    const uint32_t number = pair[0];
    return number != 0U && number != BLANK && pair[1] == ~number;
}

static uint32_t newest(const struct boot_flash *flash, unsigned *sector)
{
    uint32_t number = 0;
    *sector = 0;
    for (unsigned s = 0; s < 2U; s++) {
        for (uint32_t i = 0; i < flash->words; i += 2U) {
            const volatile uint32_t *pair = flash->sector[s] + i;
            if (is_number(pair) && pair[0] > number) {
                number = pair[0];
                *sector = s;
            }
        }
    }
    return number;
}

/* Words in use at the start of a sector: what follows is blank. */
static uint32_t used(const struct boot_flash *flash, unsigned sector)
{
    uint32_t words = flash->words;
    while (words > 0U && flash->sector[sector][words - 1U] == BLANK && flash->sector[sector][words - 2U] == BLANK) {
        words -= 2U;
    }
    return words;
}

uint32_t boot_id_next(const struct boot_flash *flash)
{
    unsigned sector = 0;
    const uint32_t number = newest(flash, &sector) + 1U;
    uint32_t words = used(flash, sector);
    if (words == flash->words) {
        sector = 1U - sector;
        words = 0;
        if (!flash->erase(sector)) {
            return 0;
        }
    }
    const volatile uint32_t *pair = flash->sector[sector] + words;
    const bool written = flash->program(pair, number) && flash->program(pair + 1, ~number);
    return written && is_number(pair) && pair[0] == number ? number : 0U;
}
