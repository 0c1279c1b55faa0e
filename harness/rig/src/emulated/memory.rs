//! The target's memory: whole pages of this process that the translated code reads and writes directly.
//!
//! The one module of this crate with unsafe code: [`Mapped`] keeps the memory and the processor that points into it together.
#![allow(unsafe_code, reason = "the emulator is given raw pointers to the target's memory")]

use rigless::emulator::{Alias, Error, Memory as GuestMemory, Processor};
use rigless::soc::{Region, Width};
use std::ops::Range;

/// What the memory holds at power-on, when nobody can know. Not zero, so that firmware that relies on zero fails here and not only on a board.
pub(super) const UNKNOWN: u8 = 0xA5;

const PAGE: usize = 4096;

#[repr(C, align(4096))]
#[derive(Clone, Copy)]
struct Page([u8; PAGE]);

/// One region of the part and every address at which it answers.
#[derive(Debug)]
struct Bytes {
    starts: Vec<u64>,
    writable: bool,
    pages: *mut [Page],
    size: usize,
}

// SAFETY: the sole owner of its pages.
unsafe impl Send for Bytes {}

impl Bytes {
    fn new(region: &Region, starts: Vec<u64>) -> Self {
        let size = region.size as usize;
        let pages = Box::into_raw(vec![Page([region.erased; PAGE]); size.div_ceil(PAGE)].into_boxed_slice());
        Self { starts, writable: region.kind.is_writable(), pages, size }
    }

    fn start(&self) -> *mut u8 {
        self.pages.cast()
    }

    fn bytes(&self) -> &[u8] {
        // SAFETY: `size` bytes lie within the pages; translated code writes to them only within `Mapped::split`'s processor, never while this borrow lives.
        unsafe { std::slice::from_raw_parts(self.start(), self.size) }
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as above, and `self` is borrowed alone.
        unsafe { std::slice::from_raw_parts_mut(self.start(), self.size) }
    }
}

impl Drop for Bytes {
    fn drop(&mut self) {
        // SAFETY: made by `Box::into_raw`, given back once.
        drop(unsafe { Box::from_raw(self.pages) });
    }
}

/// All memory of the part.
#[derive(Debug)]
pub(super) struct Memory {
    regions: Vec<Bytes>,
    /// What was written behind the processor's back since it last heard of that.
    written: Vec<Range<u64>>,
}

impl Memory {
    pub(super) fn new(map: &[Region], aliases: &[Alias]) -> Self {
        let regions = map
            .iter()
            .filter(|region| region.size > 0)
            .map(|region| {
                let others = aliases.iter().filter(|alias| alias.region == region.name).map(|alias| alias.at);
                Bytes::new(region, std::iter::once(region.base).chain(others).collect())
            })
            .collect();
        Self { regions, written: Vec::new() }
    }

    fn find(&self, address: u64, length: usize) -> Option<(usize, usize)> {
        self.regions.iter().enumerate().find_map(|(index, region)| {
            region.starts.iter().find_map(|&start| {
                let offset = usize::try_from(address.checked_sub(start)?).ok()?;
                (offset.checked_add(length)? <= region.size).then_some((index, offset))
            })
        })
    }

    /// `length` bytes at `address`, where memory holds all of them.
    pub(super) fn slice(&self, address: u64, length: usize) -> Option<&[u8]> {
        let (index, offset) = self.find(address, length)?;
        self.regions.get(index)?.bytes().get(offset..offset + length)
    }

    pub(super) fn word(&self, address: u64) -> Option<u32> {
        self.slice(address, 4)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
    }

    pub(super) fn value(&self, address: u64, width: Width) -> Option<u64> {
        let bytes = self.slice(address, width.bytes() as usize)?;
        Some(bytes.iter().rev().fold(0, |value, &byte| value << 8 | u64::from(byte)))
    }

    /// Whether the firmware can write at `address`; `None` where there is no memory.
    pub(super) fn writable(&self, address: u64) -> Option<bool> {
        self.find(address, 1).and_then(|(index, _)| self.regions.get(index)).map(|region| region.writable)
    }

    /// Stores `bytes`, in memory that only a programmer can write too. False where it does not all fit.
    pub(super) fn place(&mut self, address: u64, bytes: &[u8]) -> bool {
        let Some((index, offset)) = self.find(address, bytes.len()) else { return false };
        let Some(place) =
            self.regions.get_mut(index).and_then(|region| region.bytes_mut().get_mut(offset..offset + bytes.len()))
        else {
            return false;
        };
        place.copy_from_slice(bytes);
        let range = address..address + bytes.len() as u64;
        match self.written.last_mut() {
            Some(last) if last.end == range.start => last.end = range.end,
            _ => self.written.push(range),
        }
        true
    }

    /// What the supply's absence does to everything that the firmware can write.
    pub(super) fn forget(&mut self) {
        for region in self.regions.iter_mut().filter(|region| region.writable) {
            region.bytes_mut().fill(UNKNOWN);
            let size = region.size as u64;
            self.written.extend(region.starts.iter().map(|&start| start..start + size));
        }
    }

    /// What the processor has to hear of.
    pub(super) fn take_written(&mut self) -> std::vec::Drain<'_, Range<u64>> {
        self.written.drain(..)
    }
}

impl GuestMemory for Memory {
    fn read(&mut self, address: u64, width: Width) -> Result<u64, Error> {
        self.value(address, width).ok_or(Error::Memory { address, width })
    }

    fn write(&mut self, address: u64, width: Width, value: u64) -> Result<(), Error> {
        let bytes = value.to_le_bytes();
        let stored = self.writable(address) == Some(true)
            && bytes.get(..width.bytes() as usize).is_some_and(|bytes| self.place(address, bytes));
        if stored { Ok(()) } else { Err(Error::Memory { address, width }) }
    }
}

/// Lets `core` read and write `memory` without asking.
///
/// # Safety
/// `memory` outlives `core`, wherever both are moved; and no borrow of its bytes lives while `core` runs.
pub(super) unsafe fn map(memory: &Memory, core: &mut dyn Processor) -> Result<(), String> {
    let page = core.page_size();
    for region in &memory.regions {
        for &start in &region.starts {
            let length = region.size as u64;
            if !core.maps(start, length) {
                return Err(format!("{length} bytes at {start:#010x} cannot be mapped"));
            }
            // What ends within a page is left to the bus.
            if start.is_multiple_of(page) && length.is_multiple_of(page) {
                // SAFETY: whole pages of an allocation that does not move and, says the caller, is kept.
                unsafe { core.map(start, length, region.start(), region.writable) };
            }
        }
    }
    Ok(())
}
