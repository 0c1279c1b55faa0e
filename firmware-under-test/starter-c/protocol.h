/* Encodes and decodes the messages of the bench (docs/wire-protocol.md, version 1).
 *
 * protocol.c and protocol.h need only the C library and any little-endian or big-endian CPU with
 * IEEE 754 floats. Copy both into a project of your own; MIT or Apache-2.0, as you like. */
#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    MAX_BODY = 64,
    MAX_FRAME = MAX_BODY + 6, /* CRC, one COBS byte, delimiter */
};

enum kind {
    HELLO = 1,
    IDENTITY,
    CONFIGURE,
    CONFIGURED,
    SAMPLE,
    COMMAND,
    SAFE,
    FAULT_REPORT,
    TICK,
    SETPOINT,
    TELEMETRY,
};

enum law_number { OPEN_LOOP, DQ_PI, DQ_PI_EULER, VOLTAGE_ONLY, FREQUENCY_ONLY, BANG_BANG, PLL, DEADBEAT, DQ_PI_FIXED, LAWS };

enum capability {
    CAN_PACE_ITSELF = 1 << 0,
    MEASURES_STEP_TIME = 1 << 1,
    ACCEPTS_LOOP_DELAY = 1 << 2,
    HAS_OWN_PLATE = 1 << 3,
};

enum configure_bit { HAS_GAINS = 1 << 0, PACED_BY_TARGET = 1 << 1, HAS_LOOP_DELAY = 1 << 2, DRIVES_OWN_PLATE = 1 << 3 };

enum configured_result { ACCEPTED, UNUSABLE_VALUE, UNKNOWN_LAW };

enum state { STATE_IDLE, STATE_RUNNING, STATE_FAULT, STATE_SAFE };

enum cause { CAUSE_NONE, CAUSE_SAMPLE_TIMEOUT, CAUSE_REJECTED_FRAMES, CAUSE_NOT_FINITE };

enum flag { SATURATED = 1, FREQUENCY_LIMITED = 2, FREQUENCY_HELD = 4, PREDICTION_MISSED = 8 };

enum fault_code { FAULT_PANIC = 1, FAULT_HARD, FAULT_WATCHDOG_RESET };

struct identity {
    uint8_t version[3];
    uint8_t capabilities;
    uint32_t laws; /* bit n: law n */
    uint8_t build[8];
    uint32_t chip;
    uint8_t unique[12];
    char name[16];
};

struct gains {
    float amplitude_kp; /* Vpp/um */
    float amplitude_ki; /* Vpp/(um s) */
    float frequency_kp; /* rad/s per unit of Wq/Wd */
    float frequency_ki; /* rad/s per unit and second */
};

struct configure {
    uint8_t law;
    uint8_t bits; /* enum configure_bit */
    uint16_t watchdog_timeout_ms;
    uint32_t period_us;
    uint32_t start_frequency_mhz;
    float gain_um_per_vpp;
    float time_constant_s;
    float response_time_s;
    float drive_limit_vpp;
    float frequency_range_hz;
    float frequency_slew_hz;
    struct gains gains;
    uint32_t loop_delay_us;
};

struct sample {
    uint32_t time_us;
    float setpoint_um;
    float wd_um;
    float wq_um;
};

struct command {
    uint32_t time_us;
    float drive_vpp;
    uint32_t frequency_mhz;
    uint8_t state; /* enum state */
    uint8_t cause; /* enum cause */
    uint8_t flags; /* enum flag */
    uint16_t step_us;
};

struct fault_report {
    uint16_t code; /* enum fault_code */
    uint32_t pc;
    uint32_t lr;
    uint32_t cfsr;
    uint32_t address;
};

/* A valid message. The members of the union belong to CONFIGURE and SAMPLE; other messages from the
 * bench have no values that a controller without its own plate needs. */
struct message {
    uint8_t kind; /* enum kind */
    uint8_t sequence;
    union {
        struct configure configure;
        struct sample sample;
    };
};

/* Zero is the initial state. */
struct frame_reader {
    uint8_t bytes[MAX_FRAME];
    size_t length;
    bool overlong;
};

enum frame_result { FRAME_INCOMPLETE, FRAME_REJECTED, FRAME_MESSAGE };

/* Takes one byte from the line. Sets `message` only if the result is FRAME_MESSAGE. */
enum frame_result frame_reader_push(struct frame_reader *reader, uint8_t byte, struct message *message);

/* All of these write a complete frame with its delimiter and return its length. */
size_t encode_frame(const uint8_t *body, size_t length, uint8_t frame[MAX_FRAME]);
size_t encode_identity(uint8_t sequence, const struct identity *identity, uint8_t frame[MAX_FRAME]);
size_t encode_configured(uint8_t sequence, enum configured_result result, const struct gains *gains,
                         uint8_t frame[MAX_FRAME]);
size_t encode_command(uint8_t sequence, const struct command *command, uint8_t frame[MAX_FRAME]);
size_t encode_fault_report(uint8_t sequence, const struct fault_report *report, uint8_t frame[MAX_FRAME]);

#endif
