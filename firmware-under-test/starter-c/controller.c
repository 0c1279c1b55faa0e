#include "controller.h"

#include <math.h>

enum {
    DEFAULT_WATCHDOG_PERIODS = 5,
    REJECTED_FRAME_WEIGHT = 2,
    MAX_REJECTED_FRAME_SCORE = 10,
};

static void stop(struct controller *controller, enum state state, enum cause cause)
{
    controller->output.drive_vpp = 0.0f;
    controller->output.state = state;
    controller->output.cause = cause;
    controller->output.flags = 0;
}

static size_t report(const struct controller *controller, uint8_t frame[MAX_FRAME])
{
    return encode_command(controller->last_sequence, &controller->output, frame);
}

static bool is_positive(float value)
{
    return isfinite(value) && value > 0.0f;
}

static bool are_finite(const struct gains *gains)
{
    return isfinite(gains->amplitude_kp) && isfinite(gains->amplitude_ki) && isfinite(gains->frequency_kp) &&
           isfinite(gains->frequency_ki);
}

static enum configured_result check(const struct identity *identity, const struct configure *configure)
{
    /* An identity without laws announces an own law, which ignores the number. */
    if (identity->laws != 0 && !(identity->laws >> configure->law & 1u)) {
        return UNKNOWN_LAW;
    }
    /* Pacing, a loop delay and an own plate are not part of this firmware. */
    bool usable = (configure->bits & ~HAS_GAINS) == 0 && configure->period_us > 0 &&
                  configure->start_frequency_mhz > 0 && is_positive(configure->gain_um_per_vpp) &&
                  is_positive(configure->time_constant_s) && is_positive(configure->drive_limit_vpp) &&
                  is_positive(configure->frequency_range_hz) && is_positive(configure->frequency_slew_hz) &&
                  isfinite(configure->response_time_s) && configure->response_time_s >= 0.0f;
    return usable ? ACCEPTED : UNUSABLE_VALUE;
}

static uint32_t watchdog_timeout_us(const struct configure *configure)
{
    if (configure->watchdog_timeout_ms > 0) {
        return configure->watchdog_timeout_ms * 1000u;
    }
    uint64_t timeout = (uint64_t)configure->period_us * DEFAULT_WATCHDOG_PERIODS;
    return timeout < UINT32_MAX ? (uint32_t)timeout : UINT32_MAX;
}

static size_t configure(struct controller *controller, const struct message *message, uint8_t frame[MAX_FRAME])
{
    const struct configure *configure = &message->configure;
    struct gains gains = {0};
    enum configured_result result = check(&controller->identity, configure);
    if (result == ACCEPTED) {
        gains = law_configure(&controller->law, configure);
        result = are_finite(&gains) ? ACCEPTED : UNUSABLE_VALUE;
    }
    stop(controller, STATE_IDLE, CAUSE_NONE);
    controller->has_last_sequence = false;
    controller->last_sequence = 0;
    controller->is_configured = result == ACCEPTED;
    if (result == ACCEPTED) {
        controller->output.time_us = 0;
        controller->output.frequency_mhz = configure->start_frequency_mhz;
        controller->start_frequency_mhz = configure->start_frequency_mhz;
        controller->watchdog_timeout_us = watchdog_timeout_us(configure);
    } else {
        gains = (struct gains){0};
    }
    return encode_configured(message->sequence, result, &gains, frame);
}

static bool is_watchdog_expired(const struct controller *controller, uint32_t now_us)
{
    return now_us - controller->last_sample_us >= controller->watchdog_timeout_us;
}

static void step(struct controller *controller, const struct sample *sample, uint32_t now_us)
{
    struct command *output = &controller->output;
    output->time_us = now_us;
    bool starts = output->state == STATE_IDLE && controller->is_configured;
    if (!starts && output->state != STATE_RUNNING) {
        return;
    }
    if (starts) {
        controller->rejected_frame_score = 0;
    } else if (is_watchdog_expired(controller, now_us)) {
        stop(controller, STATE_FAULT, CAUSE_SAMPLE_TIMEOUT);
        return;
    }
    if (!isfinite(sample->setpoint_um) || !isfinite(sample->wd_um) || !isfinite(sample->wq_um)) {
        stop(controller, STATE_FAULT, CAUSE_NOT_FINITE);
        return;
    }
    struct actuation actuation = law_step(&controller->law, sample);
    if (!isfinite(actuation.drive_vpp) || !isfinite(actuation.frequency_offset_hz)) {
        stop(controller, STATE_FAULT, CAUSE_NOT_FINITE);
        return;
    }
    controller->last_sample_us = now_us;
    if (controller->rejected_frame_score > 0) {
        controller->rejected_frame_score--;
    }
    int64_t frequency = (int64_t)controller->start_frequency_mhz + lroundf(actuation.frequency_offset_hz * 1000.0f);
    output->drive_vpp = actuation.drive_vpp;
    output->frequency_mhz = frequency > 0 ? (uint32_t)frequency : 0;
    output->state = STATE_RUNNING;
    output->cause = CAUSE_NONE;
    output->flags = actuation.flags;
}

void controller_start(struct controller *controller, const struct identity *identity)
{
    *controller = (struct controller){.identity = *identity};
}

size_t controller_receive(struct controller *controller, const struct message *message, uint32_t now_us,
                          uint8_t frame[MAX_FRAME])
{
    switch (message->kind) {
    case HELLO:
        return encode_identity(message->sequence, &controller->identity, frame);
    case CONFIGURE:
        return configure(controller, message, frame);
    case SAMPLE: {
        /* The line repeated a frame: repeat the answer without a control step. */
        bool repeated = controller->has_last_sequence && controller->last_sequence == message->sequence;
        controller->has_last_sequence = true;
        controller->last_sequence = message->sequence;
        if (!repeated) {
            step(controller, &message->sample, now_us);
        }
        return report(controller, frame);
    }
    case SAFE:
        controller->output.time_us = now_us;
        stop(controller, STATE_SAFE, CAUSE_NONE);
        return encode_command(message->sequence, &controller->output, frame);
    default:
        return 0; /* an echo of the line, or a message for a controller with its own plate */
    }
}

size_t controller_reject_frame(struct controller *controller, uint32_t now_us, uint8_t frame[MAX_FRAME])
{
    if (controller->output.state != STATE_RUNNING) {
        return 0;
    }
    controller->rejected_frame_score += REJECTED_FRAME_WEIGHT;
    if (controller->rejected_frame_score < MAX_REJECTED_FRAME_SCORE) {
        return 0;
    }
    controller->output.time_us = now_us;
    stop(controller, STATE_FAULT, CAUSE_REJECTED_FRAMES);
    return report(controller, frame);
}

size_t controller_tick(struct controller *controller, uint32_t now_us, uint8_t frame[MAX_FRAME])
{
    if (controller->output.state != STATE_RUNNING || !is_watchdog_expired(controller, now_us)) {
        return 0;
    }
    controller->output.time_us = now_us;
    stop(controller, STATE_FAULT, CAUSE_SAMPLE_TIMEOUT);
    return report(controller, frame);
}
