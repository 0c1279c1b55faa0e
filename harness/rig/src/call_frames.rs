//! Steps from a function to its caller by the call frame information (CFI) of an image, section
//! `.debug_frame` (DWARF 5, chapter 6.4; register numbers: DWARF for the ARM Architecture, 4.1).

use gimli::{
    BaseAddresses, CfaRule, DebugFrame, EndianArcSlice, Register, RegisterRule, RunTimeEndian, UnwindContext,
    UnwindSection as _,
};

const FIRST_SAVED: u16 = 4;
const SP: u16 = 13;
const LR: u16 = 14;
const ADDRESS_BYTES: u8 = 4;

/// Core registers that decide where a function's caller is. `None` if the value is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct FrameRegisters {
    pub(crate) sp: u32,
    pub(crate) lr: Option<u32>,
    /// Registers r4 to r11, which a function preserves.
    pub(crate) saved: [Option<u32>; 8],
}

impl FrameRegisters {
    pub(crate) fn get(&self, register: u16) -> Option<u32> {
        match register {
            SP => Some(self.sp),
            LR => self.lr,
            _ => *self.saved.get(usize::from(register.checked_sub(FIRST_SAVED)?))?,
        }
    }
}

/// The caller's registers after the return.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Caller {
    pub(crate) return_address: u32,
    pub(crate) registers: FrameRegisters,
    /// Register from which the address of the frame follows.
    pub(crate) base: u16,
}

pub(crate) struct CallFrames(DebugFrame<EndianArcSlice<RunTimeEndian>>);

impl CallFrames {
    pub(crate) fn new(section: EndianArcSlice<RunTimeEndian>) -> Self {
        let mut frames = DebugFrame::from(section);
        frames.set_address_size(ADDRESS_BYTES);
        Self(frames)
    }

    /// Returns the caller of the function that contains `address`. `None` if the image has no CFI
    /// for it, or if a register or a word that the rules need is not known.
    pub(crate) fn caller(
        &self,
        address: u32,
        registers: &FrameRegisters,
        word: impl Fn(u32) -> Option<u32>,
    ) -> Option<Caller> {
        let mut context = UnwindContext::new();
        let row = self
            .0
            .unwind_info_for_address(
                &BaseAddresses::default(),
                &mut context,
                address.into(),
                DebugFrame::cie_from_offset,
            )
            .ok()?;
        let CfaRule::RegisterAndOffset { register: base, offset } = row.cfa() else { return None };
        let at = |from: u32, offset: i64| u32::try_from(i64::from(from) + offset).ok();
        let frame = at(registers.get(base.0)?, *offset)?;
        let value = |register: u16| match row.register(Register(register)) {
            // By convention, a function preserves these registers.
            None | Some(RegisterRule::SameValue) => registers.get(register),
            Some(RegisterRule::Offset(offset)) => word(at(frame, offset)?),
            Some(RegisterRule::ValOffset(offset)) => at(frame, offset),
            Some(RegisterRule::Register(other)) => registers.get(other.0),
            Some(_) => None,
        };
        let mut saved = [None; 8];
        for (register, slot) in (FIRST_SAVED..).zip(&mut saved) {
            *slot = value(register);
        }
        let registers = FrameRegisters { sp: frame, lr: None, saved };
        Some(Caller { return_address: value(LR)?, registers, base: base.0 })
    }
}
