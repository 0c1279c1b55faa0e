//! Stores the target's memory in pages that translated code accesses directly.
#![allow(unsafe_code, reason = "the emulator holds raw pointers to the target's memory")]

use rigless::emulator::{Alias, Error, Memory as GuestMemory, Processor};
use rigless::soc::{Region, Width};
use std::ops::Range;

/// Content of RAM after power-on. It is not zero, so that firmware that relies on zeroed RAM fails.
pub(super) const POWER_ON_FILL: u8 = 0xA5;

const PAGE: usize = 4096;

#[repr(C, align(4096))]
#[derive(Clone, Copy)]
struct Page([u8; PAGE]);

#[derive(Debug)]
struct MemoryRegion {
    starts: Vec<u64>,
    writable: bool,
    pages: *mut [Page],
    size: usize,
}

// SAFETY: the region is the only owner of its pages.
unsafe impl Send for MemoryRegion {}

impl MemoryRegion {
    fn new(region: &Region, starts: Vec<u64>) -> Self {
        let size = region.size as usize;
        let pages = Box::into_raw(vec![Page([region.erased; PAGE]); size.div_ceil(PAGE)].into_boxed_slice());
        Self { starts, writable: region.kind.is_writable(), pages, size }
    }

    fn start(&self) -> *mut u8 {
        self.pages.cast()
    }

    fn bytes(&self) -> &[u8] {
        // SAFETY: `size` bytes lie within the pages; translated code writes to them only while the
        // processor runs, and no borrow lives then.
        unsafe { std::slice::from_raw_parts(self.start(), self.size) }
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as above, and the borrow of `self` is exclusive.
        unsafe { std::slice::from_raw_parts_mut(self.start(), self.size) }
    }
}

impl Drop for MemoryRegion {
    fn drop(&mut self) {
        // SAFETY: the pointer comes from `Box::into_raw` and is freed once.
        drop(unsafe { Box::from_raw(self.pages) });
    }
}

#[derive(Debug)]
pub(super) struct Memory {
    regions: Vec<MemoryRegion>,
    /// Ranges that changed without the processor, which must discard its translated code there.
    dirty_ranges: Vec<Range<u64>>,
}

impl Memory {
    pub(super) fn new(map: &[Region], aliases: &[Alias]) -> Self {
        let regions = map
            .iter()
            .filter(|region| region.size > 0)
            .map(|region| {
                let others = aliases.iter().filter(|alias| alias.region == region.name).map(|alias| alias.at);
                MemoryRegion::new(region, std::iter::once(region.base).chain(others).collect())
            })
            .collect();
        Self { regions, dirty_ranges: Vec::new() }
    }

    fn find(&self, address: u64, length: usize) -> Option<(usize, usize)> {
        self.regions.iter().enumerate().find_map(|(index, region)| {
            region.starts.iter().find_map(|&start| {
                let offset = usize::try_from(address.checked_sub(start)?).ok()?;
                (offset.checked_add(length)? <= region.size).then_some((index, offset))
            })
        })
    }

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

    /// `None` if there is no memory at `address`.
    pub(super) fn is_writable(&self, address: u64) -> Option<bool> {
        self.find(address, 1).and_then(|(index, _)| self.regions.get(index)).map(|region| region.writable)
    }

    /// Also writes to flash. Returns false if no region contains all of `bytes`.
    pub(super) fn store(&mut self, address: u64, bytes: &[u8]) -> bool {
        let Some((index, offset)) = self.find(address, bytes.len()) else { return false };
        let Some(place) =
            self.regions.get_mut(index).and_then(|region| region.bytes_mut().get_mut(offset..offset + bytes.len()))
        else {
            return false;
        };
        place.copy_from_slice(bytes);
        let range = address..address + bytes.len() as u64;
        match self.dirty_ranges.last_mut() {
            Some(last) if last.end == range.start => last.end = range.end,
            _ => self.dirty_ranges.push(range),
        }
        true
    }

    pub(super) fn power_off(&mut self) {
        for region in self.regions.iter_mut().filter(|region| region.writable) {
            region.bytes_mut().fill(POWER_ON_FILL);
            let size = region.size as u64;
            self.dirty_ranges.extend(region.starts.iter().map(|&start| start..start + size));
        }
    }

    /// Content of the writable regions.
    pub(super) fn ram(&self) -> Vec<Vec<u8>> {
        self.regions.iter().filter(|region| region.writable).map(|region| region.bytes().to_vec()).collect()
    }

    /// Restores what [`Self::ram`] returned.
    pub(super) fn restore_ram(&mut self, ram: &[Vec<u8>]) {
        for (region, content) in self.regions.iter_mut().filter(|region| region.writable).zip(ram) {
            region.bytes_mut().copy_from_slice(content);
            let size = region.size as u64;
            self.dirty_ranges.extend(region.starts.iter().map(|&start| start..start + size));
        }
    }

    pub(super) fn take_dirty_ranges(&mut self) -> std::vec::Drain<'_, Range<u64>> {
        self.dirty_ranges.drain(..)
    }
}

impl GuestMemory for Memory {
    fn read(&mut self, address: u64, width: Width) -> Result<u64, Error> {
        self.value(address, width).ok_or(Error::Memory { address, width })
    }

    fn write(&mut self, address: u64, width: Width, value: u64) -> Result<(), Error> {
        let bytes = value.to_le_bytes();
        let stored = self.is_writable(address) == Some(true)
            && bytes.get(..width.bytes() as usize).is_some_and(|bytes| self.store(address, bytes));
        if stored { Ok(()) } else { Err(Error::Memory { address, width }) }
    }
}

/// Lets `core` access `memory` directly.
///
/// # Safety
/// `memory` outlives `core`, and no borrow of its bytes lives while `core` runs.
pub(super) unsafe fn map_into_core(memory: &Memory, core: &mut dyn Processor) -> Result<(), String> {
    let page = core.page_size();
    for region in &memory.regions {
        for &start in &region.starts {
            let length = region.size as u64;
            if !core.maps(start, length) {
                return Err(format!("{length} bytes at {start:#010x} cannot be mapped"));
            }
            // Accesses to regions that are not whole pages go through the bus.
            if start.is_multiple_of(page) && length.is_multiple_of(page) {
                // SAFETY: whole pages of an allocation that does not move and, by contract,
                // outlives `core`.
                unsafe { core.map(start, length, region.start(), region.writable) };
            }
        }
    }
    Ok(())
}
