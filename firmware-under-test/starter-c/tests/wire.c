/* Runs protocol.c on a computer for tests/tests/bench/starter_c.rs.
 *
 * Prints the frames of some messages of a controller. Then reads lines of hexadecimal digits, each the bytes of a new
 * line to a controller, and prints for each the messages in it. */
#include "../protocol.h"

#include <stdio.h>
#include <string.h>

static void print_frame(const char *name, const uint8_t *frame, size_t length)
{
    printf("%s", name);
    for (size_t at = 0; at < length; at++) {
        printf(" %02x", frame[at]);
    }
    printf("\n");
}

/* The values of docs/examples/test-vectors.txt. */
static void print_vectors(void)
{
    uint8_t frame[MAX_FRAME];
    struct identity identity = {
        .version = {0, 1, 0},
        .capabilities = CAN_PACE_ITSELF | MEASURES_STEP_TIME,
        .laws = 1u << OPEN_LOOP | 1u << DQ_PI | 1u << DQ_PI_EULER,
        .build = {0xa0, 0xa1, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7},
        .chip = 0x10000413,
        .unique = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12},
        .name = "firmware",
    };
    print_frame("identity", frame, encode_identity(1, &identity, frame));
    struct gains gains = {400.0f, 200000.0f, 1500.0f, 750000.0f};
    print_frame("configured", frame, encode_configured(5, ACCEPTED, &gains, frame));
    struct command command = {1234, 400.0f, 32307600, STATE_RUNNING, CAUSE_NONE, SATURATED | FREQUENCY_HELD, 300};
    print_frame("running", frame, encode_command(3, &command, frame));
    struct command safe = {2234, 0.0f, 32307600, STATE_SAFE, CAUSE_NONE, 0, 300};
    print_frame("safe", frame, encode_command(4, &safe, frame));
    struct fault_report report = {FAULT_HARD, 0x08001234, 0x08000001, 0x01000000, 0xdeadbeef};
    print_frame("fault", frame, encode_fault_report(0, &report, frame));
}

static uint32_t bits(float value)
{
    uint32_t result;
    memcpy(&result, &value, sizeof result);
    return result;
}

static void print_message(const struct message *message)
{
    printf(" [%u %u", message->kind, message->sequence);
    if (message->kind == SAMPLE) {
        const struct sample *sample = &message->sample;
        printf(" %x %x %x %x", (unsigned)sample->time_us, (unsigned)bits(sample->setpoint_um),
               (unsigned)bits(sample->wd_um), (unsigned)bits(sample->wq_um));
    } else if (message->kind == CONFIGURE) {
        const struct configure *configure = &message->configure;
        printf(" %x %x %x %x %x", configure->law, configure->bits, configure->watchdog_timeout_ms,
               (unsigned)configure->period_us, (unsigned)configure->start_frequency_mhz);
        const float values[] = {
            configure->gain_um_per_vpp,    configure->time_constant_s,    configure->response_time_s,
            configure->drive_limit_vpp,    configure->frequency_range_hz, configure->frequency_slew_hz,
        };
        for (size_t at = 0; at < sizeof values / sizeof *values; at++) {
            printf(" %x", (unsigned)bits(values[at]));
        }
        const struct gains none = {0};
        const struct gains *gains = configure->bits & HAS_GAINS ? &configure->gains : &none;
        printf(" %x %x %x %x %x", (unsigned)bits(gains->amplitude_kp), (unsigned)bits(gains->amplitude_ki),
               (unsigned)bits(gains->frequency_kp), (unsigned)bits(gains->frequency_ki),
               (unsigned)configure->loop_delay_us);
    }
    printf("]");
}

int main(void)
{
    print_vectors();
    char line[4096];
    while (fgets(line, sizeof line, stdin)) {
        struct frame_reader reader = {0};
        struct message message;
        unsigned byte;
        for (const char *at = line; sscanf(at, "%2x", &byte) == 1; at += 2) {
            switch (frame_reader_push(&reader, (uint8_t)byte, &message)) {
            case FRAME_MESSAGE:
                print_message(&message);
                break;
            case FRAME_REJECTED:
                printf(" rejected");
                break;
            case FRAME_INCOMPLETE:
                break;
            }
        }
        printf("\n");
    }
    return 0;
}
