/* Refusals and causes in words. The sentences are those of hilbo/device/reasons.py where both have one. */
#include <stdio.h>

#include "orders.h"

/* Of the reasons that a caller of this library can meet: formats of `value` and `limit`. */
static const char *of_reason(uint8_t reason)
{
    switch (reason) {
    case HB_NACK_RESERVED:
        return "A set has either taps (short memory) or exponentials (full memory); give one of them.";
    case HB_NACK_STATE:
        return "The renderer is in another state than this order is for; look at hilbo_state, then stop or clear it.";
    case HB_NACK_NOT_FINITE:
        return "A number of the set is not finite; send finite ones.";
    case HB_NACK_K0_RANGE:
        return "K0 is %.7g N/mm, beyond the device's limit of %.7g.";
    case HB_NACK_K1_RANGE:
        return "K1 is %.7g N/mm, beyond the device's limit of %.7g.";
    case HB_NACK_B1_RANGE:
        return "B1 is %.7g N.s^alpha/mm, beyond the device's limit of %.7g.";
    case HB_NACK_ALPHA_RANGE:
        return "alpha is %.7g, beyond the device's limit of %.7g.";
    case HB_NACK_FORCE_LIMIT:
        return "The force limit is %.7g N; the device allows above 0 and up to %.7g N.";
    case HB_NACK_MEMORY_LENGTH:
        return "The set's memory has length %.7g, the device takes 1 to %.7g.";
    case HB_NACK_EVEN_TAPS:
        return "N is even; the passivity bound needs an odd number of past samples, such as 101.";
    case HB_NACK_STATIC_STIFFNESS:
        return "The set's static stiffness H(1) is %.7g N/mm; below 0 it is active on any device, raise K0.";
    case HB_NACK_NOT_PASSIVE:
        return "The set needs %.7g N.s/m of damping and the device has %.7g; lower K1, or search with this device's "
               "damping.";
    case HB_NACK_STATES:
        return "The exponentials of full memory are out of range or order; use those of hilbo.mechanics.exponentials.";
    case HB_NACK_SET_MISMATCH:
        return "The newest set was refused, and is not in force; give another set first.";
    case HB_NACK_NO_SET:
        return "There is no set in force; give one first.";
    case HB_NACK_NO_HEARTBEAT:
        return "There was no heartbeat for too long; call hilbo_heartbeat from the thread that gives the orders.";
    case HB_NACK_NO_INPUT:
        return "There is no good position; call hilbo_tick with positions of the device first, and check its encoder.";
    case HB_NACK_IN_CONTACT:
        return "The handle is in the material; let it leave the surface, then start.";
    case HB_NACK_STALE:
        return "There has been a stop since this order was made; look at the state, then give it again.";
    default:
        return NULL;
    }
}

void orders_sentence(const struct orders *orders, char *text, size_t room)
{
    const struct hb_nack *refusal = &orders->refusal;
    const double value = (double)refusal->value, limit = (double)refusal->limit;
    const char *sentence = of_reason(refusal->reason);
    if (refusal->reason == (uint8_t)HB_ACCEPTED) {
        (void)snprintf(text, room, "%s", "");
    } else if (refusal->reason == (uint8_t)HB_NACK_NOT_READY) {
        (void)snprintf(text, room, "The newest set needs up to %lu more ticks until it is in force; wait, or let go.",
                       (unsigned long)refusal->ticks);
    } else if (refusal->reason == (uint8_t)HB_NACK_BUSY) {
        (void)snprintf(text, room, "The renderer needs %lu more ticks for what it was asked before; wait.",
                       (unsigned long)refusal->ticks);
    } else if (sentence == NULL) {
        (void)snprintf(text, room, "Refused for reason %d of firmware/PROTOCOL.md.", (int)refusal->reason);
    } else {
        (void)snprintf(text, room, sentence, value, limit); /* those with fewer numbers ignore the rest */
    }
}

const char *hilbo_cause_in_words(uint32_t cause)
{
    switch (cause) {
    case HILBO_CAUSE_NONE:
        return "it was asked to";
    case HILBO_CAUSE_WATCHDOG:
        return "no heartbeat came from the thread that gives the orders";
    case HILBO_CAUSE_INPUT:
        return "too many positions were bad; check the encoder";
    case HILBO_CAUSE_VELOCITY:
        return "it moved faster than its velocity limit";
    case HILBO_CAUSE_OVERRUN:
        return "a tick was missed, or its force came out later than the device's delay";
    case HILBO_CAUSE_MODEL:
        return "the model's force was not finite";
    case HILBO_CAUSE_ESTOP:
        return "the emergency stop was asked for";
    case HILBO_CAUSE_BOOT:
        return "it has just started";
    case HILBO_CAUSE_HEAT:
        return "the mean force was above what the motor bears continuously";
    case HILBO_CAUSE_CLOCK:
        return "the times of the ticks did not rise, were no numbers, or came much too often";
    default:
        return "of a reason without a name";
    }
}
