/* Runs the controller on an STM32F4: sleeps until the line is idle after a frame or a millisecond has passed. */
#include "board.h"
#include "controller.h"
#include "line.h"
#include "stm32f4.h"

static struct controller controller;
static struct frame_reader reader;
static bool amplifier_is_on;

static void apply_output(void)
{
    bool running = controller.output.state == STATE_RUNNING;
    if (running != amplifier_is_on) {
        amplifier_is_on = running;
        amplifier_enable(running);
    }
    /* A board with converters writes controller.output.drive_vpp and .frequency_mhz here. */
}

static void receive(uint8_t byte)
{
    struct message message;
    uint8_t frame[MAX_FRAME];
    uint32_t since = now_us();
    enum frame_result result = frame_reader_push(&reader, byte, &message);
    size_t length = 0;
    if (result == FRAME_MESSAGE) {
        length = controller_receive(&controller, &message, since, frame);
    } else if (result == FRAME_REJECTED) {
        length = controller_reject_frame(&controller, since, frame);
    }
    apply_output();
    line_send(frame, length);
    if (result == FRAME_MESSAGE && message.kind == SAMPLE) {
        uint32_t took = now_us() - since;
        controller.output.step_us = (uint16_t)(took < UINT16_MAX ? took : UINT16_MAX);
    }
}

int main(void)
{
    amplifier_start();
    struct clocks clocks = clocks_start();
    microseconds_start(&clocks);
    watchdog_start();
    line_start(clocks.apb1_hz);
    uint8_t frame[MAX_FRAME];
    if (watchdog_caused_reset()) {
        struct fault_report report = {.code = FAULT_WATCHDOG_RESET};
        line_send(frame, encode_fault_report(0, &report, frame));
    }
    struct identity identity = board_identity();
    controller_start(&controller, &identity);
    tick_start(&clocks);
    for (;;) {
        /* Masked until the sleep, so that no interrupt is missed; a masked one ends the sleep too. */
        disable_interrupts();
        if (!line_is_pending() && !tick_is_pending()) {
            wait_for_interrupt();
        }
        enable_interrupts();
        watchdog_feed();
        const uint8_t *bytes;
        for (size_t count; (count = line_take(&bytes)) > 0;) {
            for (size_t at = 0; at < count; at++) {
                receive(bytes[at]);
            }
        }
        if (tick_take()) {
            size_t length = controller_tick(&controller, now_us(), frame);
            apply_output();
            line_send(frame, length);
        }
    }
}
