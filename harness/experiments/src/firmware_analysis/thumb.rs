//! Splits Thumb-2 code into instructions and finds where control continues.
//!
//! Encodings: ARM DDI 0403E (ARMv7-M), chapters A5 and A7.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    pub first: u16,
    /// Second halfword; `None` if the instruction has 16 bits.
    pub second: Option<u16>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flow {
    Next,
    Conditional(u32),
    Jump(u32),
    Call(Option<u32>),
    /// A table of targets with entries of this many bytes follows.
    Table(u32),
    /// Control continues at an address in a register or on the stack.
    Indirect,
}

impl Instruction {
    /// `None` at the end of the code.
    pub(crate) fn decode(address: u32, code: &[u8]) -> Option<Self> {
        let halfword = |at: usize| Some(u16::from_le_bytes(*code.get(at..)?.first_chunk()?));
        let first = halfword(0)?;
        let second = if first >> 11 >= 0b11101 { Some(halfword(2)?) } else { None };
        Some(Self { address, first, second })
    }

    pub fn end(&self) -> u32 {
        self.address + if self.second.is_some() { 4 } else { 2 }
    }

    pub fn bytes(&self) -> Vec<u8> {
        let halfwords = [Some(self.first), self.second];
        halfwords.into_iter().flatten().flat_map(u16::to_le_bytes).collect()
    }

    /// Value of the program counter as the instruction reads it.
    pub(crate) fn pc(&self) -> u32 {
        self.address.wrapping_add(4)
    }

    pub(crate) fn flow(&self) -> Flow {
        match self.second {
            None => self.narrow_flow(),
            Some(second) => self.wide_flow(second),
        }
    }

    fn target(&self, offset: u32, bits: u32) -> u32 {
        let shift = 32 - bits;
        self.pc().wrapping_add(((offset << shift).cast_signed() >> shift).cast_unsigned())
    }

    fn narrow_flow(&self) -> Flow {
        let first = self.first;
        let low = u32::from(first);
        match first >> 12 {
            0b1101 if first >> 8 & 0xF == 0xE => Flow::Indirect,
            0b1101 if first >> 8 & 0xF < 0xE => Flow::Conditional(self.target((low & 0xFF) << 1, 9)),
            0b1110 => Flow::Jump(self.target((low & 0x7FF) << 1, 12)),
            0b1011 if first & 0x0500 == 0x0100 => {
                Flow::Conditional(self.pc().wrapping_add((low >> 9 & 1) << 6 | (low >> 3 & 0x1F) << 1))
            }
            0b1011 if first & 0x0F00 == 0x0D00 => Flow::Indirect,
            0b0100 if first & 0x0F80 == 0x0780 => Flow::Call(None),
            0b0100 if first & 0x0F80 == 0x0700 || first & 0x0D87 == 0x0487 => Flow::Indirect,
            _ => Flow::Next,
        }
    }

    fn wide_flow(&self, second: u16) -> Flow {
        let (first, high, low) = (self.first, u32::from(self.first), u32::from(second));
        if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 {
            return Flow::Table(1 + (low >> 4 & 1));
        }
        let loads_pc =
            (first & 0xFE50 == 0xE810 && second & 0x8000 != 0) || (first & 0xFF70 == 0xF850 && second >> 12 == 15);
        if loads_pc {
            return Flow::Indirect;
        }
        if first & 0xF800 != 0xF000 || second & 0x8000 == 0 {
            return Flow::Next;
        }
        let sign = high >> 10 & 1;
        let (j1, j2) = (low >> 13 & 1, low >> 11 & 1);
        let far = || {
            let (i1, i2) = (1 ^ j1 ^ sign, 1 ^ j2 ^ sign);
            self.target(sign << 24 | i1 << 23 | i2 << 22 | (high & 0x3FF) << 12 | (low & 0x7FF) << 1, 25)
        };
        match (second >> 14 & 1, second >> 12 & 1) {
            (1, 1) => Flow::Call(Some(far())),
            (0, 1) => Flow::Jump(far()),
            (0, 0) if high >> 6 & 0xF < 0xE => Flow::Conditional(
                self.target(sign << 20 | j2 << 19 | j1 << 18 | (high & 0x3F) << 12 | (low & 0x7FF) << 1, 21),
            ),
            _ => Flow::Next,
        }
    }
}

/// Condition and mask of an `IT`. `None` for hints, which share the encoding, and others.
pub(crate) fn it_condition(instruction: &Instruction) -> Option<(u16, u16)> {
    let is_it = instruction.first & 0xFF00 == 0xBF00 && instruction.first & 0xF != 0;
    is_it.then_some((instruction.first >> 4 & 0xF, instruction.first & 0xF))
}

/// Number of instructions that an `IT` with this mask makes conditional.
pub(crate) fn it_length(mask: u16) -> u32 {
    4 - mask.trailing_zeros().min(3)
}
