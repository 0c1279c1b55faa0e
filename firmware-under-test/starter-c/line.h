/* Receives and sends bytes on USART2: PA2 (TX), PA3 (RX), 8N1, with DMA. */
#ifndef LINE_H
#define LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void line_start(uint32_t apb1_hz);

/* True if the line became idle and bytes may wait. */
bool line_is_pending(void);

/* Sets `bytes` to the next received bytes and returns their number. Call it until it returns 0. */
size_t line_take(const uint8_t **bytes);

/* Waits for the end of the transfer before, which is bounded, and starts this one. */
void line_send(const uint8_t *bytes, size_t length);

/* Without interrupts and DMA, for fault handlers; bounded. */
void line_send_by_polling(const uint8_t *bytes, size_t length);

#endif
