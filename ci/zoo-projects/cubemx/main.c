/* Runs the controller of the C starter in the form that STM32CubeMX generates: HAL, FreeRTOS, TIM6
 * as the time base of HAL, USART2 with DMA and the idle line, a button on EXTI. ST's and FreeRTOS's
 * sources are not part of it. */
#include "controller.h"
#include "stm32f4xx_hal.h"

#include "FreeRTOS.h"
#include "task.h"

#include <string.h>

enum { BAUD = 1000000, RING = 512 };

static UART_HandleTypeDef huart2;
static DMA_HandleTypeDef hdma_usart2_rx, hdma_usart2_tx;
static TIM_HandleTypeDef htim2;
static TaskHandle_t control_task;
static uint8_t ring[RING];
static volatile uint16_t written;
static volatile uint32_t presses;

void vApplicationStackOverflowHook(TaskHandle_t task, char *name);
void USART2_IRQHandler(void), DMA1_Stream5_IRQHandler(void), DMA1_Stream6_IRQHandler(void), EXTI15_10_IRQHandler(void);

static void Error_Handler(void)
{
    HAL_GPIO_WritePin(GPIOB, GPIO_PIN_0, GPIO_PIN_RESET);
    NVIC_SystemReset();
}

static void SystemClock_Config(void)
{
    __HAL_RCC_PWR_CLK_ENABLE();
    __HAL_PWR_VOLTAGESCALING_CONFIG(PWR_REGULATOR_VOLTAGE_SCALE1);
    RCC_OscInitTypeDef oscillator = {
        .OscillatorType = RCC_OSCILLATORTYPE_HSE,
        .HSEState = RCC_HSE_ON,
        .PLL = {RCC_PLL_ON, RCC_PLLSOURCE_HSE, .PLLM = 8, .PLLN = 336, .PLLP = RCC_PLLP_DIV2, .PLLQ = 7},
    };
    if (HAL_RCC_OscConfig(&oscillator) != HAL_OK) {
        Error_Handler();
    }
    RCC_ClkInitTypeDef clocks = {
        .ClockType = RCC_CLOCKTYPE_HCLK | RCC_CLOCKTYPE_SYSCLK | RCC_CLOCKTYPE_PCLK1 | RCC_CLOCKTYPE_PCLK2,
        .SYSCLKSource = RCC_SYSCLKSOURCE_PLLCLK,
        .AHBCLKDivider = RCC_SYSCLK_DIV1,
        .APB1CLKDivider = RCC_HCLK_DIV4,
        .APB2CLKDivider = RCC_HCLK_DIV2,
    };
    if (HAL_RCC_ClockConfig(&clocks, FLASH_LATENCY_5) != HAL_OK) {
        Error_Handler();
    }
}

static void MX_GPIO_Init(void)
{
    __HAL_RCC_GPIOA_CLK_ENABLE();
    __HAL_RCC_GPIOB_CLK_ENABLE();
    __HAL_RCC_GPIOC_CLK_ENABLE();
    HAL_GPIO_WritePin(GPIOB, GPIO_PIN_0, GPIO_PIN_RESET);
    GPIO_InitTypeDef enable = {.Pin = GPIO_PIN_0, .Mode = GPIO_MODE_OUTPUT_PP, .Speed = GPIO_SPEED_FREQ_LOW};
    HAL_GPIO_Init(GPIOB, &enable);
    GPIO_InitTypeDef button = {.Pin = GPIO_PIN_13, .Mode = GPIO_MODE_IT_FALLING, .Pull = GPIO_PULLUP};
    HAL_GPIO_Init(GPIOC, &button);
    HAL_NVIC_SetPriority(EXTI15_10_IRQn, 5, 0);
    HAL_NVIC_EnableIRQ(EXTI15_10_IRQn);
}

static void MX_DMA_Init(void)
{
    __HAL_RCC_DMA1_CLK_ENABLE();
    HAL_NVIC_SetPriority(DMA1_Stream5_IRQn, 5, 0);
    HAL_NVIC_EnableIRQ(DMA1_Stream5_IRQn);
    HAL_NVIC_SetPriority(DMA1_Stream6_IRQn, 5, 0);
    HAL_NVIC_EnableIRQ(DMA1_Stream6_IRQn);
}

static void MX_TIM2_Init(void)
{
    htim2.Instance = TIM2;
    htim2.Init.Prescaler = 83;
    htim2.Init.CounterMode = TIM_COUNTERMODE_UP;
    htim2.Init.Period = 0xFFFFFFFF;
    if (HAL_TIM_Base_Init(&htim2) != HAL_OK || HAL_TIM_Base_Start(&htim2) != HAL_OK) {
        Error_Handler();
    }
}

static void MX_USART2_UART_Init(void)
{
    huart2.Instance = USART2;
    huart2.Init.BaudRate = BAUD;
    huart2.Init.WordLength = UART_WORDLENGTH_8B;
    huart2.Init.StopBits = UART_STOPBITS_1;
    huart2.Init.Parity = UART_PARITY_NONE;
    huart2.Init.Mode = UART_MODE_TX_RX;
    huart2.Init.HwFlowCtl = UART_HWCONTROL_NONE;
    huart2.Init.OverSampling = UART_OVERSAMPLING_16;
    if (HAL_UART_Init(&huart2) != HAL_OK) {
        Error_Handler();
    }
}

void HAL_MspInit(void)
{
    __HAL_RCC_SYSCFG_CLK_ENABLE();
    __HAL_RCC_PWR_CLK_ENABLE();
    HAL_NVIC_SetPriority(PendSV_IRQn, 15, 0);
}

void HAL_TIM_Base_MspInit(TIM_HandleTypeDef *handle)
{
    if (handle->Instance == TIM2) {
        __HAL_RCC_TIM2_CLK_ENABLE();
    }
}

static void start_stream(DMA_HandleTypeDef *stream, DMA_Stream_TypeDef *instance, uint32_t direction, uint32_t mode)
{
    stream->Instance = instance;
    stream->Init.Channel = DMA_CHANNEL_4;
    stream->Init.Direction = direction;
    stream->Init.PeriphInc = DMA_PINC_DISABLE;
    stream->Init.MemInc = DMA_MINC_ENABLE;
    stream->Init.PeriphDataAlignment = DMA_PDATAALIGN_BYTE;
    stream->Init.MemDataAlignment = DMA_MDATAALIGN_BYTE;
    stream->Init.Mode = mode;
    stream->Init.Priority = DMA_PRIORITY_LOW;
    stream->Init.FIFOMode = DMA_FIFOMODE_DISABLE;
    if (HAL_DMA_Init(stream) != HAL_OK) {
        Error_Handler();
    }
}

void HAL_UART_MspInit(UART_HandleTypeDef *handle)
{
    __HAL_RCC_USART2_CLK_ENABLE();
    GPIO_InitTypeDef pins = {
        .Pin = GPIO_PIN_2 | GPIO_PIN_3,
        .Mode = GPIO_MODE_AF_PP,
        .Pull = GPIO_PULLUP,
        .Speed = GPIO_SPEED_FREQ_VERY_HIGH,
        .Alternate = GPIO_AF7_USART2,
    };
    HAL_GPIO_Init(GPIOA, &pins);
    start_stream(&hdma_usart2_rx, DMA1_Stream5, DMA_PERIPH_TO_MEMORY, DMA_CIRCULAR);
    __HAL_LINKDMA(handle, hdmarx, hdma_usart2_rx);
    start_stream(&hdma_usart2_tx, DMA1_Stream6, DMA_MEMORY_TO_PERIPH, DMA_NORMAL);
    __HAL_LINKDMA(handle, hdmatx, hdma_usart2_tx);
    HAL_NVIC_SetPriority(USART2_IRQn, 5, 0);
    HAL_NVIC_EnableIRQ(USART2_IRQn);
}

void USART2_IRQHandler(void) { HAL_UART_IRQHandler(&huart2); }
void DMA1_Stream5_IRQHandler(void) { HAL_DMA_IRQHandler(&hdma_usart2_rx); }
void DMA1_Stream6_IRQHandler(void) { HAL_DMA_IRQHandler(&hdma_usart2_tx); }
void EXTI15_10_IRQHandler(void) { HAL_GPIO_EXTI_IRQHandler(GPIO_PIN_13); }

void HAL_GPIO_EXTI_Callback(uint16_t pin)
{
    presses += pin == GPIO_PIN_13;
}

/* Idle line, half or end of the ring. */
void HAL_UARTEx_RxEventCallback(UART_HandleTypeDef *handle, uint16_t size)
{
    (void)handle;
    BaseType_t woken = pdFALSE;
    written = size % RING;
    if (control_task != NULL) {
        vTaskNotifyGiveFromISR(control_task, &woken);
    }
    portYIELD_FROM_ISR(woken);
}

static uint32_t now_us(void) { return __HAL_TIM_GET_COUNTER(&htim2); }

static void send(const uint8_t *bytes, size_t length)
{
    static uint8_t leaving[MAX_FRAME];
    if (length == 0) {
        return;
    }
    for (uint32_t since = now_us(); huart2.gState != HAL_UART_STATE_READY && now_us() - since < 5000;) { }
    memcpy(leaving, bytes, length);
    HAL_UART_Transmit_DMA(&huart2, leaving, (uint16_t)length);
}

static void control(void *unused)
{
    (void)unused;
    static struct controller controller;
    static struct frame_reader reader;
    struct identity identity = {
        .version = {0, 1, 0}, .laws = 1u << DQ_PI, .chip = DBGMCU->IDCODE, .name = "zoo-cubemx"};
    controller_start(&controller, &identity);
    uint16_t taken = 0;
    uint32_t last_tick = xTaskGetTickCount();
    HAL_UARTEx_ReceiveToIdle_DMA(&huart2, ring, RING);
    for (;;) {
        uint8_t frame[MAX_FRAME];
        ulTaskNotifyTake(pdTRUE, pdMS_TO_TICKS(1));
        for (uint16_t end = written; taken != end; taken = (taken + 1) % RING) {
            struct message message;
            enum frame_result result = frame_reader_push(&reader, ring[taken], &message);
            if (result == FRAME_MESSAGE) {
                send(frame, controller_receive(&controller, &message, now_us(), frame));
            } else if (result == FRAME_REJECTED) {
                send(frame, controller_reject_frame(&controller, now_us(), frame));
            }
        }
        if (xTaskGetTickCount() != last_tick) {
            last_tick = xTaskGetTickCount();
            send(frame, controller_tick(&controller, now_us(), frame));
        }
        bool running = controller.output.state == STATE_RUNNING;
        HAL_GPIO_WritePin(GPIOB, GPIO_PIN_0, running ? GPIO_PIN_SET : GPIO_PIN_RESET);
    }
}

void vApplicationStackOverflowHook(TaskHandle_t task, char *name)
{
    (void)task;
    (void)name;
    Error_Handler();
}

int main(void)
{
    HAL_Init();
    SystemClock_Config();
    MX_GPIO_Init();
    MX_DMA_Init();
    MX_TIM2_Init();
    MX_USART2_UART_Init();
    if (xTaskCreate(control, "control", 1024, NULL, 24, &control_task) != pdPASS) {
        Error_Handler();
    }
    vTaskStartScheduler();
    Error_Handler();
}
