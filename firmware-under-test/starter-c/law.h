/* The control law `dq-pi`: one PI loop for the amplitude and one for the excitation frequency, with gains that follow
 * the damping of the plate (docs/wire-protocol.md). Replace law.h and law.c to test another law. */
#ifndef LAW_H
#define LAW_H

#include "damping.h"
#include "protocol.h"

struct pi {
    float kp;
    float ki_per_period;
    float integral;
};

struct law {
    struct pi amplitude; /* Vpp from um */
    struct pi frequency; /* rad/s from Wq/Wd */
    struct damping damping;
    bool is_scheduled; /* no gains in the configuration: they follow the damping */
    float pole;        /* of the closed loop, per period */
    float drive_limit_vpp;
    float range;  /* of the frequency, rad/s */
    float slew;   /* of the frequency, rad/s per period */
    float offset; /* from the start frequency, rad/s */
};

struct actuation {
    float drive_vpp;
    float frequency_offset_hz;
    uint8_t flags;
};

/* Clears the state of the law and returns the gains in force. */
struct gains law_configure(struct law *law, const struct configure *configure);

/* One control step. */
struct actuation law_step(struct law *law, const struct sample *sample);

#endif
