//! Contains the ELF of the bench's firmware for STM32F405, F407 and F427, built from
//! `firmware-under-test/stm32f4`.

pub const BUILT_IN_IMAGE: &[u8] = include_bytes!("../../../firmware-under-test/images/platebench-stm32f4.elf");
