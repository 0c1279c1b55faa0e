//! Checks that each planned fault of the chip has an instant and only the options of its kind.

use super::checker::Checker;
use crate::scenario::chip_fault::{BitFlipTarget, ChipFault, ChipFaultKind, parse_address};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::RawFault;
use platebench_plate::Time;

/// Largest clock error. A UART misreads bytes at a larger one.
const MAX_DRIFT_PPM: f64 = 20_000.0;

impl Checker<'_> {
    pub(super) fn chip_fault(&self, raw: &RawFault, duration: Time) -> Result<ChipFault, Diagnostic> {
        let kind = self.chip_fault_kind(raw)?;
        let flips = matches!(kind, ChipFaultKind::BitFlip { .. });
        let sticks = matches!(kind, ChipFaultKind::Stuck { .. });
        let options = [
            ("from_ms", raw.from_ms.is_some(), false),
            ("until_ms", raw.until_ms.is_some(), false),
            ("direction", raw.direction.is_some(), false),
            ("every", raw.every.is_some(), false),
            ("delay_ms", raw.delay_ms.is_some(), false),
            ("factor", raw.factor.is_some(), false),
            ("seed", raw.seed.is_some(), false),
            ("reconfigure", raw.reconfigure, false),
            ("target", raw.target.is_some(), flips || sticks),
            ("bit", raw.bit.is_some(), flips),
            ("value", raw.value.is_some(), sticks),
            ("ppm", raw.ppm.is_some(), matches!(kind, ChipFaultKind::ClockDrift(_))),
        ];
        self.check_options(&format!("a fault of kind `{}`", raw.kind), &options)?;
        let at = match (raw.at_ms, raw.random) {
            (Some(ms), false) => {
                let at = self.time_from_ms("at_ms", ms)?;
                self.require(at < duration, "at_ms", || {
                    format!("{ms} ms, expected before the scenario's end at {duration}")
                })?;
                Some(at)
            }
            (None, true) => None,
            _ => return self.error("kind", format!("`{}` needs either `at_ms` or `random = true`", raw.kind)),
        };
        Ok(ChipFault { kind, at })
    }

    fn chip_fault_kind(&self, raw: &RawFault) -> Result<ChipFaultKind, Diagnostic> {
        let target = raw.target.as_deref().unwrap_or_default();
        Ok(match raw.kind.as_str() {
            "reset" => ChipFaultKind::Reset,
            "power-cut" => ChipFaultKind::PowerCut,
            "hang" => ChipFaultKind::Hang,
            "clock-drift" => {
                let Some(ppm) = raw.ppm.filter(|ppm| ppm.abs() <= MAX_DRIFT_PPM && *ppm != 0.0) else {
                    let expected = format!("expected `ppm`, -{MAX_DRIFT_PPM} to {MAX_DRIFT_PPM}, not 0");
                    return self.error("ppm", expected);
                };
                ChipFaultKind::ClockDrift(ppm)
            }
            "stuck" => {
                let address = target.strip_prefix("peripheral:").and_then(parse_address);
                let Some(address) = address.filter(|address| address.is_multiple_of(4)) else {
                    let expected = format!("`{target}`, expected \"peripheral:0x40000024\", the address of a register");
                    return self.error("target", expected);
                };
                let Some(value) = raw.value.and_then(|value| u32::try_from(value).ok()) else {
                    return self.error("value", "expected `value`, 0 to 0xffffffff: what every read returns");
                };
                ChipFaultKind::Stuck { address, value }
            }
            _ => {
                let Some(target) = BitFlipTarget::parse(target) else {
                    let expected = format!("`{target}`, expected {}", BitFlipTarget::EXPECTED);
                    return self.error("target", expected);
                };
                let bits = match target {
                    BitFlipTarget::Ram { length, .. } => u64::from(length) * 8,
                    BitFlipTarget::Register(_) => 32,
                    BitFlipTarget::Variable(_) => u64::from(u32::MAX),
                };
                let fits = raw.bit.is_none_or(|bit| u64::try_from(bit).is_ok_and(|bit| bit < bits));
                self.require(fits, "bit", || format!("expected 0 to {}", bits - 1))?;
                ChipFaultKind::BitFlip { target, bit: raw.bit.map(|bit| bit as u32) }
            }
        })
    }
}
