#include "line.h"
#include "board.h"
#include "stm32f4.h"

#include <string.h>

/* A divisor of both APB1 clocks: 42 MHz and 16 MHz. */
#define BAUD 1000000u

enum { RING = 512, TAKE_WITHOUT_IDLE = RING / 2, OUTBOX = 128 };

enum { ENABLE = 1, TO_PERIPHERAL = 1 << 6, CIRCULAR = 1 << 8, MEMORY_INCREMENT = 1 << 10, CHANNEL_4 = 4 << 25 };
enum { RECEIVE = CHANNEL_4 | MEMORY_INCREMENT | CIRCULAR, SEND = CHANNEL_4 | MEMORY_INCREMENT | TO_PERIPHERAL };

/* In SRAM: the DMA has no access to the CCM at 0x10000000. */
static uint8_t received[RING];
static uint8_t leaving[OUTBOX];
static size_t taken;
static volatile bool idle;

void line_start(uint32_t apb1_hz)
{
    RCC_AHB1ENR |= 1u | 1u << 21; /* GPIOA, DMA1 */
    RCC_APB1ENR |= 1u << 17;      /* USART2, before its first register */
    GPIOA_PUPDR = (GPIOA_PUPDR & ~(3u << 6)) | 1u << 6; /* PA3 pull-up */
    GPIOA_AFRL = (GPIOA_AFRL & ~(0xFFu << 8)) | 0x77u << 8;
    GPIOA_MODER = (GPIOA_MODER & ~(0xFu << 4)) | 0xAu << 4;

    DMA1_S5PAR = (uint32_t)&USART2_DR;
    DMA1_S5M0AR = (uint32_t)received;
    DMA1_S5NDTR = RING;
    DMA1_S5CR = RECEIVE;
    DMA1_S5CR = RECEIVE | ENABLE;
    DMA1_S6PAR = (uint32_t)&USART2_DR;
    DMA1_S6M0AR = (uint32_t)leaving;
    DMA1_S6CR = SEND;

    USART2_BRR = (apb1_hz + BAUD / 2u) / BAUD;
    USART2_CR3 = 1u << 7 | 1u << 6;                       /* DMAT, DMAR */
    USART2_CR1 = 1u << 13 | 1u << 4 | 1u << 3 | 1u << 2; /* UE, IDLEIE, TE, RE */
    NVIC_ISER1 = 1u << (USART2_IRQ - 32);
}

void USART2_IRQHandler(void);
void USART2_IRQHandler(void)
{
    (void)USART2_SR; /* status, then data: clears the idle flag and errors */
    (void)USART2_DR;
    idle = true;
}

bool line_is_pending(void)
{
    return idle;
}

size_t line_take(const uint8_t **bytes)
{
    bool was_idle = idle;
    if (was_idle) {
        idle = false; /* only if it was set, so that no interrupt since then is lost */
    }
    size_t written = (RING - DMA1_S5NDTR) % RING;
    size_t waiting = (written + RING - taken) % RING;
    if (waiting == 0 || (!was_idle && waiting < TAKE_WITHOUT_IDLE)) {
        return 0;
    }
    memory_barrier();
    size_t end = written > taken ? written : RING;
    size_t count = end - taken;
    *bytes = received + taken;
    taken = end % RING;
    if (taken != written) {
        idle = true; /* the ring's start follows with the next call */
    }
    return count;
}

void line_send(const uint8_t *bytes, size_t length)
{
    if (length == 0 || length > OUTBOX) {
        return;
    }
    uint32_t since = now_us();
    while (DMA1_S6CR & ENABLE && now_us() - since <= OUTBOX * 10u * (1000000u / BAUD)) {
    }
    DMA1_S6CR = SEND;
    DMA1_HIFCR = 0x3Du << 16; /* all flags of stream 6, or it does not start again */
    memcpy(leaving, bytes, length);
    memory_barrier();
    DMA1_S6NDTR = length;
    DMA1_S6CR = SEND | ENABLE;
}

void line_send_by_polling(const uint8_t *bytes, size_t length)
{
    USART2_CR3 &= ~(1u << 7);
    for (size_t at = 0; at < length; at++) {
        for (int round = 0; round < 20000 && !(USART2_SR & 1u << 7); round++) {
        }
        USART2_DR = bytes[at];
    }
}
