#include "law.h"

#include <math.h>

#define TWO_PI 6.28318531f

/* The closed loop settles to 5 % in this time, s, if the configuration has none. */
#define RESPONSE_TIME 1.9e-3f

/* Wq/Wd is used above this share of the setpoint and limited to this value. */
#define SMALLEST_WD 0.1f
#define LARGEST_RATIO 2.0f

/* Share of the anti-windup at the upper limit of the drive: full tracking settles later. */
#define DRIVE_TRACKING 0.6f

static float limit(float value, float low, float high)
{
    return fminf(fmaxf(value, low), high);
}

/* The controller's zero on the pole a = e^(-sigma Ts) of the sampled plant, the closed loop's pole at
 * p = e^(-3 Ts/tr): Kp = (1 - p)/(K (1 - a)), Ki Ts = Kp (1 - a). The integral stays. */
static void design(struct pi *pi, float plant_gain, float sigma, const struct law *law)
{
    float rest = 1.0f - expf(-sigma * law->damping.period);
    pi->kp = (1.0f - law->pole) / (plant_gain * rest);
    pi->ki_per_period = pi->kp * rest;
}

static void design_both(struct law *law)
{
    float sigma = law->damping.sigma;
    design(&law->amplitude, law->damping.force / sigma, sigma, law);
    design(&law->frequency, 1.0f / sigma, sigma, law);
}

struct gains law_configure(struct law *law, const struct configure *configure)
{
    float period = (float)configure->period_us * 1e-6f;
    float response = configure->response_time_s > 0.0f ? configure->response_time_s : RESPONSE_TIME;
    *law = (struct law){
        .is_scheduled = !(configure->bits & HAS_GAINS),
        .pole = expf(-3.0f * period / response),
        .drive_limit_vpp = configure->drive_limit_vpp,
        .range = configure->frequency_range_hz * TWO_PI,
        .slew = configure->frequency_slew_hz * TWO_PI,
    };
    law->damping = damping_start(configure, law->range, period);
    if (law->is_scheduled) {
        design_both(law);
    } else {
        const struct gains *gains = &configure->gains;
        law->amplitude = (struct pi){.kp = gains->amplitude_kp, .ki_per_period = gains->amplitude_ki * period};
        law->frequency = (struct pi){.kp = gains->frequency_kp, .ki_per_period = gains->frequency_ki * period};
    }
    return (struct gains){
        .amplitude_kp = law->amplitude.kp,
        .amplitude_ki = law->amplitude.ki_per_period / period,
        .frequency_kp = law->frequency.kp,
        .frequency_ki = law->frequency.ki_per_period / period,
    };
}

/* u = Kp e + x, y = u limited, x += Ki Ts e + c (y - u). `high_tracking` scales c at the upper limit. */
static float pi_step(struct pi *pi, float error, float low, float high, float high_tracking)
{
    float unlimited = pi->kp * error + pi->integral;
    float output = limit(unlimited, low, high);
    pi->integral += pi->ki_per_period * error;
    if (output != unlimited) {
        float ratio = pi->kp > 0.0f ? pi->ki_per_period / pi->kp : 1.0f;
        float share = output < unlimited ? high_tracking : 1.0f;
        pi->integral += fminf(1.0f, share * ratio) * (output - unlimited);
    }
    return output;
}

static void follow_damping(struct law *law, const struct sample *sample, float complex w)
{
    bool is_other_plate = damping_follow(&law->damping, w);
    design_both(law);
    if (is_other_plate) {
        /* The drive that holds the present amplitude. */
        law->amplitude.integral = law->damping.sigma * sample->wd_um / law->damping.force;
    }
}

struct actuation law_step(struct law *law, const struct sample *sample)
{
    struct actuation actuation = {0};
    float complex w = sample->wd_um + sample->wq_um * I;
    bool is_divisible = sample->setpoint_um > 0.0f && sample->wd_um > SMALLEST_WD * sample->setpoint_um;
    if (is_divisible && law->is_scheduled) {
        follow_damping(law, sample, w);
    }
    float error = sample->setpoint_um - sample->wd_um;
    actuation.drive_vpp = pi_step(&law->amplitude, error, 0.0f, law->drive_limit_vpp, DRIVE_TRACKING);
    if (actuation.drive_vpp >= law->drive_limit_vpp) {
        actuation.flags |= SATURATED;
    }
    if (is_divisible) {
        float ratio = limit(sample->wq_um / sample->wd_um, -LARGEST_RATIO, LARGEST_RATIO);
        float low = fmaxf(law->offset - law->slew, -law->range);
        float high = fminf(law->offset + law->slew, law->range);
        law->offset = pi_step(&law->frequency, ratio, low, high, 1.0f);
        if (law->offset <= low || law->offset >= high) {
            actuation.flags |= FREQUENCY_LIMITED;
        }
    } else {
        actuation.flags |= FREQUENCY_HELD;
    }
    damping_remember(&law->damping, w, actuation.drive_vpp, law->offset);
    actuation.frequency_offset_hz = law->offset / TWO_PI;
    return actuation;
}
