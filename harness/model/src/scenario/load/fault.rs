//! Checks that each planned fault has the keys of its kind, and that it acts at least once.

use super::checker::Checker;
use super::checker::MAX_DELAY_PERIODS;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::fault::{BitFlipTarget, ChipFault, ChipFaultKind, parse_address};
use crate::scenario::fault::{Direction, Fault, FaultKind};
use crate::scenario::raw::{FAULT_KEYS, RawFault, fault_keys, keys_of};
use crate::scenario::schema::help_of_fault_key;
use platebench_plate::Time;

/// A planned fault of the line or the sensor, or of the chip.
pub(super) enum CheckedFault {
    Line(Fault),
    Chip(ChipFault),
}

impl Checker<'_> {
    pub(super) fn fault(&self, raw: &RawFault, duration: Time, period: Time) -> Result<CheckedFault, Diagnostic> {
        self.check_fault_keys(raw)?;
        let text = raw.target.as_deref().unwrap_or_default();
        let line = |kind: FaultKind| self.line_fault(raw, kind, duration, period).map(CheckedFault::Line);
        let chip = |kind: ChipFaultKind| {
            let at = self.instant(raw, duration)?;
            Ok(CheckedFault::Chip(ChipFault { kind, at }))
        };
        match raw.kind.as_str() {
            "drop" => line(FaultKind::Drop),
            "flip" => line(FaultKind::Flip),
            "duplicate" => line(FaultKind::Duplicate),
            "truncate" => line(FaultKind::Truncate),
            "babble" => line(FaultKind::Babble),
            "disconnect" => line(FaultKind::Disconnect),
            "freeze" => line(FaultKind::Freeze),
            "delay" => line(FaultKind::Delay(self.delay(raw.delay_ms.unwrap_or_default(), period)?)),
            "scale" => {
                let factor = raw.factor.unwrap_or_default();
                let fits = (factor as f32).is_finite() && factor as f32 != 1.0;
                self.require(fits, "factor", || format!("{factor}, expected a finite number other than 1"))?;
                line(FaultKind::Scale(factor))
            }
            "reset" => chip(ChipFaultKind::Reset),
            "power-cut" => chip(ChipFaultKind::PowerCut),
            "hang" => chip(ChipFaultKind::Hang),
            "clock-drift" => {
                let ppm = raw.ppm.unwrap_or_default();
                self.require(ppm != 0.0, "ppm", || "0, expected an error other than 0")?;
                chip(ChipFaultKind::ClockDrift(ppm))
            }
            "stuck" => {
                let address = text.strip_prefix("peripheral:").and_then(parse_address);
                let Some(address) = address.filter(|address| address.is_multiple_of(4)) else {
                    let expected = format!("`{text}`, expected \"peripheral:0x40000024\", the address of a register");
                    return self.error("target", expected);
                };
                chip(ChipFaultKind::Stuck { address, value: raw.value.unwrap_or_default() as u32 })
            }
            _ => chip(self.bit_flip(text, raw.bit)?),
        }
    }

    fn check_fault_keys(&self, raw: &RawFault) -> Result<(), Diagnostic> {
        let kind = raw.kind.as_str();
        let Some(keys) = fault_keys(kind) else {
            let known: Vec<&str> = FAULT_KEYS.iter().map(|keys| keys.kind).collect();
            return self.unknown_name("kind", "unknown fault ", kind, &known);
        };
        let given = keys_of(raw);
        let has = |key: &&str| given.iter().any(|given| given == key);
        let applies = |key: &String| key == "kind" || keys.all().any(|known| known == key);
        if let Some(key) = given.iter().find(|key| !applies(key)) {
            return self.error(key, format!("`{key}` does not apply to a fault of kind `{kind}`"));
        }
        self.require(!raw.reconfigure || has(&"until_ms"), "reconfigure", || {
            format!("`reconfigure` does not apply to a fault of kind `{kind}` without an end")
        })?;
        match keys.required.iter().find(|key| !has(key)) {
            Some(key) => {
                self.error("kind", format!("`{kind}` without `{key}`, expected the {}", help_of_fault_key(key)))
            }
            None => Ok(()),
        }
    }

    fn line_fault(&self, raw: &RawFault, kind: FaultKind, duration: Time, period: Time) -> Result<Fault, Diagnostic> {
        let from_ms = raw.from_ms.unwrap_or_default();
        let from = self.time_from_ms("from_ms", from_ms)?;
        self.require(from < duration, "from_ms", || {
            format!("{from_ms} ms, expected before the scenario's end at {duration}")
        })?;
        let until = raw.until_ms.map(|ms| self.time_from_ms("until_ms", ms)).transpose()?;
        self.require(until.is_none_or(|until| from < until && until <= duration), "until_ms", || {
            let until = raw.until_ms.unwrap_or_default();
            format!("a window from {from} to {until} ms, expected an interval within the scenario's {duration}")
        })?;
        let every = raw.every.unwrap_or(1).unsigned_abs();
        let instants = count_control_instants(from, until.unwrap_or(duration), period);
        let at = if raw.every.is_some() { "every" } else { "from_ms" };
        self.require(every <= instants, at, || {
            format!("{instants} control instants in the window, expected at least {every}: the fault would never act")
        })?;
        let seed = raw.seed.map(i64::unsigned_abs);
        let direction = if kind.affects_sensor() { Direction::ToController } else { self.direction(raw)? };
        Ok(Fault { kind, from, until, direction, every: every as u32, seed, reconfigure: raw.reconfigure })
    }

    fn delay(&self, ms: f64, period: Time) -> Result<Time, Diagnostic> {
        let delay = self.time_from_ms("delay_ms", ms)?;
        self.require(delay > Time::ZERO && delay <= period.times(MAX_DELAY_PERIODS), "delay_ms", || {
            format!("{ms} ms, expected 1 ns to {MAX_DELAY_PERIODS} control periods")
        })?;
        Ok(delay)
    }

    fn direction(&self, raw: &RawFault) -> Result<Direction, Diagnostic> {
        let Some(name) = raw.direction.as_deref() else { return Ok(Direction::default()) };
        let all = Direction::ALL.map(|direction| (direction.name(), direction));
        self.find_by_name("direction", "unknown direction ", name, all)
    }

    /// Instant of a fault of the chip. `None` if the trial's seed selects it.
    fn instant(&self, raw: &RawFault, duration: Time) -> Result<Option<Time>, Diagnostic> {
        match (raw.at_ms, raw.random) {
            (Some(ms), false) => {
                let at = self.time_from_ms("at_ms", ms)?;
                self.require(at < duration, "at_ms", || {
                    format!("{ms} ms, expected before the scenario's end at {duration}")
                })?;
                Ok(Some(at))
            }
            (None, true) => Ok(None),
            _ => self.error("kind", format!("`{}` needs either `at_ms` or `random = true`", raw.kind)),
        }
    }

    fn bit_flip(&self, text: &str, bit: Option<i64>) -> Result<ChipFaultKind, Diagnostic> {
        let Some(target) = BitFlipTarget::parse(text) else {
            return self.error("target", format!("`{text}`, expected {}", BitFlipTarget::EXPECTED));
        };
        let bits = match target {
            BitFlipTarget::Ram { length, .. } => u64::from(length) * 8,
            BitFlipTarget::Register(_) => 32,
            BitFlipTarget::Variable(_) => u64::from(u32::MAX),
        };
        let fits = bit.is_none_or(|bit| bit.unsigned_abs() < bits);
        self.require(fits, "bit", || format!("expected 0 to {}", bits - 1))?;
        Ok(ChipFaultKind::BitFlip { target, bit: bit.map(|bit| bit as u32) })
    }
}

fn count_control_instants(from: Time, until: Time, period: Time) -> u64 {
    let before = |time: Time| time.as_nanos().div_ceil(period.as_nanos());
    before(until) - before(from)
}
