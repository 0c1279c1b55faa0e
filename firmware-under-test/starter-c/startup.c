/* Vector table, start-up, and 0 V after a trap. */
#include "board.h"
#include "line.h"
#include "stm32f4.h"

#include <string.h>

/* From stm32f4.ld. */
extern uint32_t stack_top[], data_source[], data_start[], data_end[], bss_start[], bss_end[];

int main(void);
void SysTick_Handler(void);
void USART2_IRQHandler(void);

__attribute__((noreturn)) void Reset_Handler(void);
void Fault_Handler(void);
__attribute__((noreturn, used)) void report_fault(const uint32_t *frame);

void Reset_Handler(void)
{
    SCB_CPACR |= 0xFu << 20; /* the FPU, before the first float */
    memory_barrier();
    memcpy(data_start, data_source, (size_t)((uintptr_t)data_end - (uintptr_t)data_start));
    memset(bss_start, 0, (size_t)((uintptr_t)bss_end - (uintptr_t)bss_start));
    main();
    for (;;) { /* the watchdog resets */
    }
}

/* 0 V with one store, then the report; the watchdog resets. `frame` is the stack of the exception. */
void report_fault(const uint32_t *frame)
{
    amplifier_enable(false);
    struct fault_report report = {
        .code = FAULT_HARD,
        .pc = frame[6],
        .lr = frame[5],
        .cfsr = REGISTER(0xE000ED28),
        .address = REGISTER(0xE000ED38),
    };
    uint8_t bytes[1 + MAX_FRAME] = {0}; /* the first delimiter ends an unfinished frame */
    line_send_by_polling(bytes, 1 + encode_fault_report(0, &report, bytes + 1));
    for (;;) {
    }
}

__attribute__((naked)) void Fault_Handler(void)
{
    __asm__ volatile("cpsid i\n mrs r0, msp\n b report_fault");
}

/* RM0090, table 61. */
__attribute__((section(".vectors"), used)) static void (*const vectors[16 + USART2_IRQ + 1])(void) = {
    [0] = (void (*)(void))stack_top,
    [1] = Reset_Handler,
    [2] = Fault_Handler,  /* NMI */
    [3] = Fault_Handler,  /* HardFault */
    [4] = Fault_Handler,  /* MemManage */
    [5] = Fault_Handler,  /* BusFault */
    [6] = Fault_Handler,  /* UsageFault */
    [15] = SysTick_Handler,
    [16 + USART2_IRQ] = USART2_IRQHandler,
};
