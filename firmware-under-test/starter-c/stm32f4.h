/* The registers that this firmware uses. RM0090, and the ARMv7-M manual for the core.
 * A project with ST's CMSIS headers includes stm32f4xx.h instead. */
#ifndef STM32F4_H
#define STM32F4_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define RCC_CR REGISTER(0x40023800)
#define RCC_PLLCFGR REGISTER(0x40023804)
#define RCC_CFGR REGISTER(0x40023808)
#define RCC_AHB1ENR REGISTER(0x40023830)
#define RCC_APB1ENR REGISTER(0x40023840)
#define RCC_CSR REGISTER(0x40023874)

#define FLASH_ACR REGISTER(0x40023C00)
#define PWR_CR REGISTER(0x40007000)

#define GPIOA_MODER REGISTER(0x40020000)
#define GPIOA_PUPDR REGISTER(0x4002000C)
#define GPIOA_AFRL REGISTER(0x40020020)
#define GPIOB_MODER REGISTER(0x40020400)
#define GPIOB_BSRR REGISTER(0x40020418)

#define TIM2_CR1 REGISTER(0x40000000)
#define TIM2_EGR REGISTER(0x40000014)
#define TIM2_CNT REGISTER(0x40000024)
#define TIM2_PSC REGISTER(0x40000028)
#define TIM2_ARR REGISTER(0x4000002C)

#define IWDG_KR REGISTER(0x40003000)
#define IWDG_PR REGISTER(0x40003004)
#define IWDG_RLR REGISTER(0x40003008)
#define IWDG_SR REGISTER(0x4000300C)

#define USART2_SR REGISTER(0x40004400)
#define USART2_DR REGISTER(0x40004404)
#define USART2_BRR REGISTER(0x40004408)
#define USART2_CR1 REGISTER(0x4000440C)
#define USART2_CR3 REGISTER(0x40004414)
#define USART2_IRQ 38

#define DMA1_HIFCR REGISTER(0x4002600C)
/* Stream 5 receives, stream 6 sends; both are channel 4 (RM0090, table 42). */
#define DMA1_S5CR REGISTER(0x40026088)
#define DMA1_S5NDTR REGISTER(0x4002608C)
#define DMA1_S5PAR REGISTER(0x40026090)
#define DMA1_S5M0AR REGISTER(0x40026094)
#define DMA1_S6CR REGISTER(0x400260A0)
#define DMA1_S6NDTR REGISTER(0x400260A4)
#define DMA1_S6PAR REGISTER(0x400260A8)
#define DMA1_S6M0AR REGISTER(0x400260AC)

#define DBGMCU_IDCODE REGISTER(0xE0042000)
#define DBGMCU_APB1_FZ REGISTER(0xE0042008)
#define UNIQUE_ID ((const volatile uint8_t *)0x1FFF7A10)

#define SYST_CSR REGISTER(0xE000E010)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)
#define NVIC_ISER1 REGISTER(0xE000E104)
#define SCB_CPACR REGISTER(0xE000ED88)

static inline void disable_interrupts(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
}

static inline void enable_interrupts(void)
{
    __asm__ volatile("cpsie i" ::: "memory");
}

static inline void wait_for_interrupt(void)
{
    __asm__ volatile("wfi" ::: "memory");
}

/* Stores before it are visible to the DMA before stores after it. */
static inline void memory_barrier(void)
{
    __asm__ volatile("dmb" ::: "memory");
}

#endif
