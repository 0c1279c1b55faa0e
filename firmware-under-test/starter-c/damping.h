/* Identifies the damping of the plate from sample to sample: a finger raises it. docs/wire-protocol.md, "dq-pi". */
#ifndef DAMPING_H
#define DAMPING_H

#include "protocol.h"

#include <complex.h>

struct damping {
    float sigma;   /* followed, 1/s */
    float nominal; /* of the untouched plate, 1/s */
    float force;   /* b = K1/tau, um/s per Vpp */
    float range;   /* largest distance of the resonance from the start frequency, rad/s */
    float period;  /* s */
    float pending; /* change that the next sample must confirm, 1/s; 0: none */
    float complex w; /* the sample before, um */
    float drive_vpp; /* since that sample */
    float offset;    /* of the excitation since that sample, rad/s */
};

struct damping damping_start(const struct configure *configure, float range, float period);

/* Follows the damping with the new sample `w`. True if it moved at once, because the plate is another one. */
bool damping_follow(struct damping *damping, float complex w);

/* The sample and the command that damping_follow uses with the next sample. */
void damping_remember(struct damping *damping, float complex w, float drive_vpp, float offset);

#endif
