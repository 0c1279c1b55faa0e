//! Runs `platebench-controller` on Embassy as its templates propose it: clocks from the crystal, the
//! time driver `time-driver-any`, USART2 with DMA, a button on EXTI, messages by defmt.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_futures::select::{Either, select};
use embassy_stm32::exti::{self, ExtiInput};
use embassy_stm32::gpio::{Level, Output, Pull, Speed};
use embassy_stm32::mode::Async;
use embassy_stm32::time::Hertz;
use embassy_stm32::usart::{self, Uart};
use embassy_stm32::{Config, bind_interrupts, dma, interrupt, peripherals, rcc};
use embassy_time::{Duration, Instant, Ticker};
use panic_probe as _;
use platebench_controller::Device;
use platebench_wire::{ControllerState, Identity, LawId, capabilities};

bind_interrupts!(struct Interrupts {
    USART2 => usart::InterruptHandler<peripherals::USART2>;
    DMA1_STREAM5 => dma::InterruptHandler<peripherals::DMA1_CH5>;
    DMA1_STREAM6 => dma::InterruptHandler<peripherals::DMA1_CH6>;
    EXTI15_10 => exti::InterruptHandler<interrupt::typelevel::EXTI15_10>;
});

const BAUD: u32 = 1_000_000;

/// 168 MHz from a crystal of 8 MHz.
fn config() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(rcc::Hse { freq: Hertz(8_000_000), mode: rcc::HseMode::Oscillator });
    config.rcc.pll_src = rcc::PllSource::HSE;
    config.rcc.pll = Some(rcc::Pll {
        prediv: rcc::PllPreDiv::DIV4,
        mul: rcc::PllMul::MUL168,
        divp: Some(rcc::PllPDiv::DIV2),
        divq: Some(rcc::PllQDiv::DIV7),
        divr: None,
    });
    config.rcc.ahb_pre = rcc::AHBPrescaler::DIV1;
    config.rcc.apb1_pre = rcc::APBPrescaler::DIV4;
    config.rcc.apb2_pre = rcc::APBPrescaler::DIV2;
    config.rcc.sys = rcc::Sysclk::PLL1_P;
    config
}

fn identity() -> Identity {
    Identity {
        version: [0, 1, 0],
        capabilities: capabilities::LOOP_DELAY,
        laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
        build: [0; 8],
        chip: 0,
        unique: embassy_stm32::uid::uid(),
        name: *b"zoo-embassy\0\0\0\0\0",
    }
}

fn now_us() -> u32 {
    Instant::now().as_micros() as u32
}

/// Frames that wait for the transmitter.
struct Outbox {
    bytes: [u8; 256],
    length: usize,
}

impl Outbox {
    fn put(&mut self, frame: &[u8]) {
        let end = self.length + frame.len();
        if let Some(free) = self.bytes.get_mut(self.length..end) {
            free.copy_from_slice(frame);
            self.length = end;
        }
    }
}

#[embassy_executor::task]
async fn watch_button(mut button: ExtiInput<'static, Async>) {
    loop {
        button.wait_for_falling_edge().await;
        defmt::info!("button");
    }
}

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let p = embassy_stm32::init(config());
    let mut amplifier = Output::new(p.PB0, Level::Low, Speed::Low);
    let button = ExtiInput::new(p.PC13, p.EXTI13, Pull::Up, Interrupts);
    spawner.spawn(defmt::unwrap!(watch_button(button)));

    let mut line_config = usart::Config::default();
    line_config.baudrate = BAUD;
    let line = Uart::new(p.USART2, p.PA3, p.PA2, p.DMA1_CH6, p.DMA1_CH5, Interrupts, line_config);
    let (mut transmitter, receiver) = defmt::unwrap!(line).split();
    let mut ring = [0; 512];
    let mut receiver = receiver.into_ring_buffered(&mut ring);

    let mut device = Device::new(identity());
    let mut tick = Ticker::every(Duration::from_millis(1));
    let mut state = None;
    let mut bytes = [0; 64];
    defmt::info!("ready");
    loop {
        let mut outbox = Outbox { bytes: [0; 256], length: 0 };
        match select(receiver.read(&mut bytes), tick.next()).await {
            Either::First(Ok(count)) => device.receive(&bytes[..count], now_us(), |frame| outbox.put(frame)),
            Either::First(Err(error)) => defmt::warn!("line: {}", error),
            Either::Second(()) => device.tick(now_us(), |frame| outbox.put(frame)),
        }
        let now = device.output().state;
        if state.replace(now) != Some(now) {
            defmt::info!("state {}", now as u8);
            amplifier.set_level(if now == ControllerState::Running { Level::High } else { Level::Low });
        }
        if outbox.length > 0 && transmitter.write(&outbox.bytes[..outbox.length]).await.is_err() {
            defmt::warn!("transmitter");
        }
    }
}
