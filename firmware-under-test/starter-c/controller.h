/* Answers messages and decides if the plate is driven: the state machine of docs/wire-protocol.md.
 * No access to hardware. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include "law.h"
#include "protocol.h"

struct controller {
    struct identity identity;
    struct law law;
    bool is_configured;
    bool has_last_sequence;
    uint8_t last_sequence;
    uint8_t rejected_frame_score;
    uint32_t start_frequency_mhz;
    uint32_t watchdog_timeout_us;
    uint32_t last_sample_us;
    struct command output; /* what the amplifier shall do now */
};

void controller_start(struct controller *controller, const struct identity *identity);

/* Acts on a message that arrived at `now_us`. Returns the length of the answer in `frame`; 0: no answer. */
size_t controller_receive(struct controller *controller, const struct message *message, uint32_t now_us,
                          uint8_t frame[MAX_FRAME]);

/* Counts a rejected frame. The result is that of controller_receive. */
size_t controller_reject_frame(struct controller *controller, uint32_t now_us, uint8_t frame[MAX_FRAME]);

/* 0 V if samples stopped. Call it at least every millisecond. The result is that of controller_receive. */
size_t controller_tick(struct controller *controller, uint32_t now_us, uint8_t frame[MAX_FRAME]);

#endif
