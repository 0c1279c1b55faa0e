//! Emulates the firmware's side of RTT: one ring buffer per direction in the chip's memory.

use crate::chip::Chip;
use crate::image::RTT;

const UP: u32 = 24;
const DOWN: u32 = UP + 24;
const BUFFERS: u32 = 0x100;
const SIZE: u32 = 256;
const WRITE: u32 = 12;
const READ: u32 = 16;

pub(crate) struct RttBuffers;

impl RttBuffers {
    /// Writes the control block. Its identifier is last, because it marks the block as complete.
    pub(crate) fn start(chip: &mut Chip) {
        let block = RTT;
        for (at, value) in [(16, 1), (20, 1)] {
            chip.set_word(block + at, value);
        }
        for (channel, buffer) in [(UP, block + BUFFERS), (DOWN, block + BUFFERS + SIZE)] {
            for (index, value) in (0..).zip([0, buffer, SIZE, 0, 0, 0]) {
                chip.set_word(block + channel + 4 * index, value);
            }
        }
        for (index, part) in (0..).zip(b"SEGGER RTT\0\0\0\0\0\0".as_chunks::<4>().0) {
            chip.set_word(block + 4 * index, u32::from_le_bytes(*part));
        }
    }

    pub(crate) fn read_down(chip: &mut Chip) -> Vec<u8> {
        let channel = RTT + DOWN;
        let (buffer, end) = (chip.word(channel + 4), chip.word(channel + WRITE));
        let mut at = chip.word(channel + READ);
        let mut received = Vec::new();
        while at != end {
            let address = buffer + at;
            received.push((chip.word(address & !3) >> (8 * (address & 3))) as u8);
            at = (at + 1) % SIZE;
        }
        chip.set_word(channel + READ, at);
        received
    }

    pub(crate) fn write_up(chip: &mut Chip, bytes: &[u8]) {
        let channel = RTT + UP;
        let (buffer, mut at) = (chip.word(channel + 4), chip.word(channel + WRITE));
        for &byte in bytes {
            let (address, shift) = ((buffer + at) & !3, 8 * ((buffer + at) & 3));
            let word = chip.word(address) & !(0xff << shift) | u32::from(byte) << shift;
            chip.set_word(address, word);
            at = (at + 1) % SIZE;
        }
        chip.set_word(channel + WRITE, at);
    }
}
