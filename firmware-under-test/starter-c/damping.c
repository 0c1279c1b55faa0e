#include "damping.h"

#include <math.h>

/* Quadratic convergence from a start within a factor of two. */
enum { ITERATIONS = 4 };

/* Range of sigma as a multiple of the nominal one, and its inverse. */
#define LARGEST_RATIO 6.0f
/* A change above this share of sigma needs a second sample that agrees; one below is tracked with this weight. */
#define LARGEST_TRACKED 0.25f
#define TRACKING_WEIGHT 0.125f
/* Below this |z| the quotients lose digits and the series are exact to 2e-6. */
#define SMALLEST_Z 0.03f

static float limit(float value, float low, float high)
{
    return fminf(fmaxf(value, low), high);
}

static float complex quotient(float complex a, float complex b)
{
    float complex result = a / b;
    return isfinite(crealf(result)) && isfinite(cimagf(result)) ? result : 0.0f;
}

struct damping damping_start(const struct configure *configure, float range, float period)
{
    float sigma = 1.0f / configure->time_constant_s;
    return (struct damping){
        .sigma = sigma,
        .nominal = sigma,
        .force = configure->gain_um_per_vpp * sigma,
        .range = range,
        .period = period,
    };
}

/* Newton's method for lambda = -sigma - j (omega - omega0) in
 * W = e^z W' + b V Ts phi(z), z = lambda Ts, phi(z) = (e^z - 1)/z. Returns sigma. */
static float identify(const struct damping *damping, float complex w)
{
    float sigma = damping->sigma;
    float resonance = damping->offset;
    float push = damping->force * damping->drive_vpp * damping->period;
    for (int iteration = 0; iteration < ITERATIONS; iteration++) {
        float complex z = (-sigma + (resonance - damping->offset) * I) * damping->period;
        float complex exponential = cexpf(z);
        bool small = cabsf(z) < SMALLEST_Z;
        float complex phi = small ? 1.0f + z / 2.0f + z * z / 6.0f : (exponential - 1.0f) / z;
        float complex phi_slope = small ? 0.5f + z / 3.0f : (exponential - phi) / z;
        float complex predicted = exponential * damping->w + push * phi;
        float complex slope = damping->period * (exponential * damping->w + push * phi_slope);
        float complex step = quotient(w - predicted, slope);
        sigma = limit(sigma - crealf(step), damping->nominal / LARGEST_RATIO, damping->nominal * LARGEST_RATIO);
        resonance = limit(resonance + cimagf(step), -damping->range, damping->range);
    }
    return sigma;
}

bool damping_follow(struct damping *damping, float complex w)
{
    float change = identify(damping, w) - damping->sigma;
    if (fabsf(change) <= LARGEST_TRACKED * damping->sigma) {
        damping->sigma += TRACKING_WEIGHT * change;
        damping->pending = 0.0f;
        return false;
    }
    if (change * damping->pending > 0.0f) {
        damping->sigma += fabsf(change) < fabsf(damping->pending) ? change : damping->pending;
        damping->pending = 0.0f;
        return true;
    }
    damping->pending = change;
    return false;
}

void damping_remember(struct damping *damping, float complex w, float drive_vpp, float offset)
{
    damping->w = w;
    damping->drive_vpp = drive_vpp;
    damping->offset = offset;
}
