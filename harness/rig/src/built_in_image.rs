//! Contains the firmware image of the bench, built from `firmware-under-test/stm32f4`.

/// An ELF for STM32F405, F407 and F427.
pub const BUILT_IN_IMAGE: &[u8] = include_bytes!("../../../firmware-under-test/images/platebench-stm32f4.elf");
