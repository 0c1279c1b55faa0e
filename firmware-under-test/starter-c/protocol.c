#include "protocol.h"

#include <string.h>

enum { VERSION = 1, HEADER = 2, CRC_BYTES = 4, CONFIGURE_BYTES = 54, CONFIGURE_BYTES_WITH_DELAY = 58 };

/* CRC-32/ISO-HDLC, bit by bit: 24 bytes take some 1000 instructions. */
static uint32_t crc32(const uint8_t *bytes, size_t length)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t at = 0; at < length; at++) {
        crc ^= bytes[at];
        for (int bit = 0; bit < 8; bit++) {
            crc = crc >> 1 ^ (crc & 1u ? 0xEDB88320u : 0u);
        }
    }
    return ~crc;
}

/* Little-endian fields, independent of the CPU. */

static uint8_t *put(uint8_t *to, uint32_t value, size_t bytes)
{
    for (size_t at = 0; at < bytes; at++) {
        *to++ = (uint8_t)(value >> 8 * at);
    }
    return to;
}

static uint8_t *put_float(uint8_t *to, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return put(to, bits, sizeof bits);
}

static uint8_t *put_bytes(uint8_t *to, const void *from, size_t bytes)
{
    memcpy(to, from, bytes);
    return to + bytes;
}

static uint32_t get(const uint8_t **from, size_t bytes)
{
    uint32_t value = 0;
    for (size_t at = 0; at < bytes; at++) {
        value |= (uint32_t)*(*from)++ << 8 * at;
    }
    return value;
}

static float get_float(const uint8_t **from)
{
    uint32_t bits = get(from, sizeof bits);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Each zero becomes the distance to the next zero or to the end; the byte before the data is the first zero.
 * No frame has 255 bytes, so a distance always fits. */
size_t encode_frame(const uint8_t *body, size_t length, uint8_t frame[MAX_FRAME])
{
    if (length > MAX_BODY) {
        return 0;
    }
    frame[0] = 0;
    memcpy(frame + 1, body, length);
    size_t end = (size_t)(put(frame + 1 + length, crc32(body, length), CRC_BYTES) - frame);
    size_t next = end;
    for (size_t at = end; at-- > 0;) {
        if (frame[at] == 0) {
            frame[at] = (uint8_t)(next - at);
            next = at;
        }
    }
    frame[end] = 0;
    return end + 1;
}

/* Returns the length of the body, which begins at bytes[1]; 0 if the frame is damaged. */
static size_t decode_frame(uint8_t *bytes, size_t length)
{
    size_t next = 0;
    while (next < length) {
        size_t distance = bytes[next];
        bytes[next] = 0;
        next += distance;
    }
    if (next != length || length < 1 + HEADER + CRC_BYTES) {
        return 0;
    }
    size_t body = length - 1 - CRC_BYTES;
    const uint8_t *sent = bytes + 1 + body;
    return get(&sent, CRC_BYTES) == crc32(bytes + 1, body) ? body : 0;
}

static bool decode_configure(const uint8_t *from, size_t length, struct configure *configure)
{
    configure->law = (uint8_t)get(&from, 1);
    configure->bits = (uint8_t)get(&from, 1);
    configure->watchdog_timeout_ms = (uint16_t)get(&from, 2);
    configure->period_us = get(&from, 4);
    configure->start_frequency_mhz = get(&from, 4);
    configure->gain_um_per_vpp = get_float(&from);
    configure->time_constant_s = get_float(&from);
    configure->response_time_s = get_float(&from);
    configure->drive_limit_vpp = get_float(&from);
    configure->frequency_range_hz = get_float(&from);
    configure->frequency_slew_hz = get_float(&from);
    configure->gains.amplitude_kp = get_float(&from);
    configure->gains.amplitude_ki = get_float(&from);
    configure->gains.frequency_kp = get_float(&from);
    configure->gains.frequency_ki = get_float(&from);
    bool has_delay = (configure->bits & HAS_LOOP_DELAY) != 0;
    if (length != (has_delay ? CONFIGURE_BYTES_WITH_DELAY : CONFIGURE_BYTES)) {
        return false;
    }
    configure->loop_delay_us = has_delay ? get(&from, 4) : 0;
    return configure->law < LAWS && configure->bits < DRIVES_OWN_PLATE << 1 &&
           (!has_delay || configure->loop_delay_us > 0);
}

static void decode_sample(const uint8_t *from, struct sample *sample)
{
    sample->time_us = get(&from, 4);
    sample->setpoint_um = get_float(&from);
    sample->wd_um = get_float(&from);
    sample->wq_um = get_float(&from);
}

static bool is_state_and_cause(const uint8_t *bytes)
{
    return bytes[0] <= STATE_SAFE && bytes[1] >> 4 <= CAUSE_NOT_FINITE;
}

/* False if version, kind, length or a value is invalid. Messages of a controller can arrive as an echo. */
static bool decode_message(const uint8_t *body, size_t length, struct message *message)
{
    static const uint8_t lengths[] = {
        [HELLO] = 2, [IDENTITY] = 50,     [CONFIGURED] = 20, [SAMPLE] = 18,   [COMMAND] = 18,
        [SAFE] = 2,  [FAULT_REPORT] = 20, [TICK] = 6,        [SETPOINT] = 6,  [TELEMETRY] = 37,
    };
    message->kind = body[0] & 0x0F;
    message->sequence = body[1];
    if (body[0] >> 4 != VERSION || message->kind >= sizeof lengths) {
        return false;
    }
    if (message->kind == CONFIGURE) {
        return length >= CONFIGURE_BYTES && decode_configure(body + HEADER, length, &message->configure);
    }
    if (length != lengths[message->kind]) {
        return false;
    }
    switch (message->kind) {
    case SAMPLE:
        decode_sample(body + HEADER, &message->sample);
        return true;
    case CONFIGURED:
        return body[2] <= UNKNOWN_LAW;
    case COMMAND:
        return is_state_and_cause(body + 14);
    case TELEMETRY:
        return is_state_and_cause(body + 34) && body[36] <= 1;
    default:
        return true;
    }
}

enum frame_result frame_reader_push(struct frame_reader *reader, uint8_t byte, struct message *message)
{
    if (byte != 0) {
        if (reader->length < sizeof reader->bytes) {
            reader->bytes[reader->length++] = byte;
        } else {
            reader->overlong = true;
        }
        return FRAME_INCOMPLETE;
    }
    size_t length = reader->length;
    bool overlong = reader->overlong;
    reader->length = 0;
    reader->overlong = false;
    if (length == 0) {
        return FRAME_INCOMPLETE; /* an idle line */
    }
    size_t body = overlong ? 0 : decode_frame(reader->bytes, length);
    return body > 0 && decode_message(reader->bytes + 1, body, message) ? FRAME_MESSAGE : FRAME_REJECTED;
}

static uint8_t *put_header(uint8_t *to, enum kind kind, uint8_t sequence)
{
    *to++ = (uint8_t)(VERSION << 4 | kind);
    *to++ = sequence;
    return to;
}

size_t encode_identity(uint8_t sequence, const struct identity *identity, uint8_t frame[MAX_FRAME])
{
    uint8_t body[MAX_BODY];
    uint8_t *to = put_header(body, IDENTITY, sequence);
    to = put_bytes(to, identity->version, sizeof identity->version);
    to = put(to, identity->capabilities, 1);
    to = put(to, identity->laws, 4);
    to = put_bytes(to, identity->build, sizeof identity->build);
    to = put(to, identity->chip, 4);
    to = put_bytes(to, identity->unique, sizeof identity->unique);
    to = put_bytes(to, identity->name, sizeof identity->name);
    return encode_frame(body, (size_t)(to - body), frame);
}

size_t encode_configured(uint8_t sequence, enum configured_result result, const struct gains *gains,
                         uint8_t frame[MAX_FRAME])
{
    uint8_t body[MAX_BODY];
    uint8_t *to = put_header(body, CONFIGURED, sequence);
    to = put(to, result, 1);
    to = put(to, 0, 1);
    to = put_float(to, gains->amplitude_kp);
    to = put_float(to, gains->amplitude_ki);
    to = put_float(to, gains->frequency_kp);
    to = put_float(to, gains->frequency_ki);
    return encode_frame(body, (size_t)(to - body), frame);
}

size_t encode_command(uint8_t sequence, const struct command *command, uint8_t frame[MAX_FRAME])
{
    uint8_t body[MAX_BODY];
    uint8_t *to = put_header(body, COMMAND, sequence);
    to = put(to, command->time_us, 4);
    to = put_float(to, command->drive_vpp);
    to = put(to, command->frequency_mhz, 4);
    to = put(to, command->state, 1);
    to = put(to, (uint32_t)command->cause << 4 | (command->flags & 0x0Fu), 1);
    to = put(to, command->step_us, 2);
    return encode_frame(body, (size_t)(to - body), frame);
}

size_t encode_fault_report(uint8_t sequence, const struct fault_report *report, uint8_t frame[MAX_FRAME])
{
    uint8_t body[MAX_BODY];
    uint8_t *to = put_header(body, FAULT_REPORT, sequence);
    to = put(to, report->code, 2);
    to = put(to, report->pc, 4);
    to = put(to, report->lr, 4);
    to = put(to, report->cfsr, 4);
    to = put(to, report->address, 4);
    return encode_frame(body, (size_t)(to - body), frame);
}
