#include "board.h"
#include "stm32f4.h"

#include <string.h>

/* Crystal on PH0 and PH1; without one the firmware uses the internal oscillator of 16 MHz. */
#ifndef CRYSTAL_MHZ
#define CRYSTAL_MHZ 8u
#endif
#define INTERNAL_MHZ 16u

/* First eight bytes of the SHA-256 of the sources; 0: unknown. */
#ifndef BUILD_ID
#define BUILD_ID 0ull
#endif

/* Bound of every wait. A crystal starts within a few ms; a round takes at least 6 cycles. */
enum { ROUNDS = 30000 };

static const struct clocks slow = {16000000, 16000000, 16000000};
static const struct clocks fast = {168000000, 42000000, 84000000};

static volatile bool tick;

static bool wait_until(volatile uint32_t *word, uint32_t mask, uint32_t value)
{
    for (int round = 0; round < ROUNDS; round++) {
        if ((*word & mask) == value) {
            return true;
        }
    }
    return false;
}

void amplifier_start(void)
{
    RCC_AHB1ENR |= 1u << 1; /* GPIOB */
    amplifier_enable(false); /* before the pin becomes an output */
    GPIOB_MODER = (GPIOB_MODER & ~3u) | 1u;
}

void amplifier_enable(bool enable)
{
    GPIOB_BSRR = enable ? 1u : 1u << 16; /* PB0 */
}

/* 168 MHz from the PLL: 1 MHz times 336, halved. Values and order of RM0090, chapters 5 to 7. */
struct clocks clocks_start(void)
{
    RCC_APB1ENR |= 1u << 28; /* PWR */
    PWR_CR |= 1u << 14;      /* voltage scale 1, which 168 MHz need */
    RCC_CR |= 1u << 16;      /* HSEON */
    bool crystal = wait_until(&RCC_CR, 1u << 17, 1u << 17);
    if (!crystal) {
        RCC_CR &= ~(1u << 16);
    }
    RCC_PLLCFGR = (crystal ? CRYSTAL_MHZ : INTERNAL_MHZ) | 336u << 6 | (crystal ? 1u << 22 : 0u) | 7u << 24;
    RCC_CR |= 1u << 24; /* PLLON */
    if (!wait_until(&RCC_CR, 1u << 25, 1u << 25)) {
        RCC_CR &= ~(1u << 24);
        return slow;
    }
    FLASH_ACR = 5u | 7u << 8; /* 5 wait states at 168 MHz and 3.3 V; prefetch and both caches */
    if (!wait_until(&FLASH_ACR, 7u, 5u)) {
        return slow;
    }
    const uint32_t dividers = 5u << 10 | 4u << 13; /* APB1 / 4, APB2 / 2, before the switch */
    RCC_CFGR = dividers;
    RCC_CFGR = dividers | 2u;
    if (!wait_until(&RCC_CFGR, 3u << 2, 2u << 2)) {
        RCC_CFGR = 0;
        return slow;
    }
    return fast;
}

void microseconds_start(const struct clocks *clocks)
{
    RCC_APB1ENR |= 1u; /* TIM2 */
    TIM2_PSC = clocks->timer_hz / 1000000u - 1u;
    TIM2_ARR = UINT32_MAX;
    TIM2_EGR = 1u; /* loads the prescaler */
    TIM2_CR1 = 1u;
}

uint32_t now_us(void)
{
    return TIM2_CNT;
}

/* LSI / 64, 256 counts: 0.5 s, 0.35 to 0.96 s over the tolerance of the oscillator. */
void watchdog_start(void)
{
    DBGMCU_APB1_FZ |= 1u << 12; /* a debugger that halts the core pauses the watchdog */
    IWDG_KR = 0xCCCC;
    IWDG_KR = 0x5555;
    IWDG_PR = 4;
    IWDG_RLR = 256;
    wait_until(&IWDG_SR, UINT32_MAX, 0);
    watchdog_feed();
}

void watchdog_feed(void)
{
    IWDG_KR = 0xAAAA;
}

bool watchdog_caused_reset(void)
{
    bool was = (RCC_CSR & 1u << 29) != 0;
    RCC_CSR |= 1u << 24; /* clears the causes */
    return was;
}

void tick_start(const struct clocks *clocks)
{
    SYST_RVR = clocks->core_hz / 1000u - 1u;
    SYST_CVR = 0;
    SYST_CSR = 7; /* core clock, interrupt, enable */
}

void SysTick_Handler(void);
void SysTick_Handler(void)
{
    tick = true;
}

bool tick_is_pending(void)
{
    return tick;
}

bool tick_take(void)
{
    if (!tick) {
        return false; /* a tick from here on stays */
    }
    tick = false;
    return true;
}

#ifndef ANNOUNCED_LAWS
#define ANNOUNCED_LAWS (1u << DQ_PI)
#endif

struct identity board_identity(void)
{
    struct identity identity = {
        .version = {0, 1, 0},
        .capabilities = MEASURES_STEP_TIME,
        .laws = ANNOUNCED_LAWS,
        .chip = DBGMCU_IDCODE,
    };
    for (size_t at = 0; at < sizeof identity.build; at++) {
        identity.build[at] = (uint8_t)(BUILD_ID >> (56 - 8 * at));
    }
    for (size_t at = 0; at < sizeof identity.unique; at++) {
        identity.unique[at] = UNIQUE_ID[at];
    }
    strncpy(identity.name, "starter-c", sizeof identity.name);
    return identity;
}
