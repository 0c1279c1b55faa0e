//! Negates and shifts the conditions of branches and `IT` blocks. ARM DDI 0403E, section A7.3.

use crate::firmware_analysis::thumb::{Instruction, it_condition};

const CS: u16 = 2;
const CC: u16 = 3;
const MI: u16 = 4;
const PL: u16 = 5;
const HI: u16 = 8;
const LS: u16 = 9;
const GE: u16 = 10;
const LT: u16 = 11;
const GT: u16 = 12;
const LE: u16 = 13;
const ALWAYS: u16 = 14;

type Code = (u16, Option<u16>);

pub(super) fn negate(instruction: &Instruction) -> Option<Code> {
    match (condition(instruction), instruction.second) {
        (Some(condition), _) => Some(with_condition(instruction, condition ^ 1)),
        (None, None) if instruction.first & 0xF500 == 0xB100 => Some((instruction.first ^ 0x0800, None)),
        _ => None,
    }
}

/// Moves equality to the other side, for example `<` to `≤`. After a comparison of floats, `MI` is
/// `<` and `PL` is `≥`.
pub(super) fn shift_boundary(instruction: &Instruction, compares_floats: bool) -> Option<Code> {
    let shifted = match condition(instruction)? {
        GE => GT,
        GT => GE,
        LT => LE,
        LE => LT,
        CS => HI,
        HI => CS,
        CC => LS,
        LS => CC,
        MI if compares_floats => LS,
        PL if compares_floats => HI,
        _ => return None,
    };
    Some(with_condition(instruction, shifted))
}

fn condition(instruction: &Instruction) -> Option<u16> {
    let first = instruction.first;
    let condition = match instruction.second {
        None if first & 0xF000 == 0xD000 => first >> 8 & 0xF,
        None => it_condition(instruction)?.0,
        Some(second) if first & 0xF800 == 0xF000 && second & 0xD000 == 0x8000 => first >> 6 & 0xF,
        Some(_) => return None,
    };
    (condition < ALWAYS).then_some(condition)
}

fn with_condition(instruction: &Instruction, condition: u16) -> Code {
    let first = instruction.first;
    if let Some(second) = instruction.second {
        return (first & !0x03C0 | condition << 6, Some(second));
    }
    let Some((old, mask)) = it_condition(instruction) else { return (first & !0x0F00 | condition << 8, None) };
    // The mask contains bit 0 of each further condition, so these bits change too.
    let last = mask & mask.wrapping_neg();
    let mask = if (old ^ condition) & 1 == 1 { !mask & 0xF & !(last | (last - 1)) | last } else { mask };
    (first & 0xFF00 | condition << 4 | mask, None)
}
