/* Clocks, microsecond counter, watchdog, millisecond tick, amplifier enable and identity of the chip. */
#ifndef BOARD_H
#define BOARD_H

#include "protocol.h"

struct clocks {
    uint32_t core_hz;
    uint32_t apb1_hz;
    uint32_t timer_hz;
};

/* Call it first: the amplifier is off from then on. */
void amplifier_start(void);
void amplifier_enable(bool enable);

struct clocks clocks_start(void);
void microseconds_start(const struct clocks *clocks);
uint32_t now_us(void);

void watchdog_start(void);
/* Only the main loop calls it, so that the watchdog detects a main loop that stopped. */
void watchdog_feed(void);
bool watchdog_caused_reset(void);

void tick_start(const struct clocks *clocks);
/* True once for each tick, or several ticks. */
bool tick_take(void);
bool tick_is_pending(void);

struct identity board_identity(void);

#endif
