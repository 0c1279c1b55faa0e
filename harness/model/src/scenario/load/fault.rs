//! Checks that each planned fault acts on at least one message and has only the options of its
//! kind.

use super::checker::Checker;
use crate::scenario::bounds::MAX_DELAY_PERIODS;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::fault::{Direction, Fault, FaultKind};
use crate::scenario::raw::RawFault;
use platebench_plate::Time;

impl Checker<'_> {
    pub(super) fn fault(&self, raw: &RawFault, duration: Time, period: Time) -> Result<Fault, Diagnostic> {
        let kind = self.kind(raw, period)?;
        let is_of_line = !kind.affects_sensor();
        let subject = format!("a fault of kind `{}`", raw.kind);
        let options = [
            ("delay_ms", raw.delay_ms.is_some(), matches!(kind, FaultKind::Delay(_))),
            ("factor", raw.factor.is_some(), matches!(kind, FaultKind::Scale(_))),
            ("seed", raw.seed.is_some(), kind.is_random()),
            ("direction", raw.direction.is_some(), is_of_line),
            ("every", raw.every.is_some(), kind != FaultKind::Disconnect),
        ];
        let options_with_end = [("reconfigure", raw.reconfigure, raw.until_ms.is_some())];
        let options_of_chip_faults = [
            ("at_ms", raw.at_ms.is_some(), false),
            ("random", raw.random, false),
            ("target", raw.target.is_some(), false),
            ("bit", raw.bit.is_some(), false),
            ("value", raw.value.is_some(), false),
            ("ppm", raw.ppm.is_some(), false),
        ];
        self.check_options(&subject, &options)?;
        self.check_options(&format!("{subject} without an end"), &options_with_end)?;
        self.check_options(&subject, &options_of_chip_faults)?;
        let Some(from_ms) = raw.from_ms else {
            return self.error("kind", format!("`{}` without `from_ms`, expected the start of its window", raw.kind));
        };
        let from = self.time_from_ms("from_ms", from_ms)?;
        self.require(from < duration, "from_ms", || {
            format!("{from_ms} ms, expected before the scenario's end at {duration}")
        })?;
        let until = raw.until_ms.map(|ms| self.time_from_ms("until_ms", ms)).transpose()?;
        self.require(until.is_some() || kind == FaultKind::Disconnect, "until_ms", || {
            format!(
                "`{}` without `until_ms`, expected the end of its window; only `disconnect` may last until the \
                 end of the trial",
                raw.kind
            )
        })?;
        self.require(until.is_none_or(|until| from < until && until <= duration), "until_ms", || {
            let until = raw.until_ms.unwrap_or_default();
            format!("a window from {from} to {until} ms, expected an interval within the scenario's {duration}")
        })?;
        let every = raw.every.unwrap_or(1);
        let instants = count_control_instants(from, until.unwrap_or(duration), period);
        self.require((1..=i64::from(u32::MAX)).contains(&every), "every", || {
            format!("{every}, expected 1 to {}: 2 is every second message", u32::MAX)
        })?;
        let at = if raw.every.is_some() { "every" } else { "from_ms" };
        self.require(every as u64 <= instants, at, || {
            format!("{instants} control instants in the window, expected at least {every}: the fault would never act")
        })?;
        self.require(raw.seed.is_none_or(|seed| seed >= 0), "seed", || {
            format!("{}, expected 0 or more", raw.seed.unwrap_or_default())
        })?;
        let seed = raw.seed.map(|seed| seed as u64);
        let direction = if is_of_line { self.direction(raw)? } else { Direction::ToController };
        Ok(Fault { kind, from, until, direction, every: every as u32, seed, reconfigure: raw.reconfigure })
    }

    fn kind(&self, raw: &RawFault, period: Time) -> Result<FaultKind, Diagnostic> {
        Ok(match raw.kind.as_str() {
            "drop" => FaultKind::Drop,
            "flip" => FaultKind::Flip,
            "duplicate" => FaultKind::Duplicate,
            "truncate" => FaultKind::Truncate,
            "babble" => FaultKind::Babble,
            "disconnect" => FaultKind::Disconnect,
            "freeze" => FaultKind::Freeze,
            "delay" => {
                let Some(ms) = raw.delay_ms else {
                    return self.error("delay_ms", "`delay` without `delay_ms`, expected a time");
                };
                let delay = self.time_from_ms("delay_ms", self.positive("delay_ms", ms)?)?;
                self.require(delay > Time::ZERO && delay <= period.times(MAX_DELAY_PERIODS), "delay_ms", || {
                    format!("{ms} ms, expected 1 ns to {MAX_DELAY_PERIODS} control periods")
                })?;
                FaultKind::Delay(delay)
            }
            "scale" => {
                let Some(factor) = raw.factor else {
                    return self.error("factor", "`scale` without `factor`, expected a number");
                };
                let fits = (factor as f32).is_finite() && factor as f32 != 1.0;
                self.require(fits, "factor", || format!("{factor}, expected a finite number other than 1"))?;
                FaultKind::Scale(factor)
            }
            name => {
                return self.unknown_name("kind", "unknown fault ", name, &FaultKind::all_names());
            }
        })
    }

    fn direction(&self, raw: &RawFault) -> Result<Direction, Diagnostic> {
        let Some(name) = raw.direction.as_deref() else { return Ok(Direction::default()) };
        let all = Direction::ALL.map(|direction| (direction.name(), direction));
        self.find_by_name("direction", "unknown direction ", name, all)
    }
}

fn count_control_instants(from: Time, until: Time, period: Time) -> u64 {
    let before = |time: Time| time.as_nanos().div_ceil(period.as_nanos());
    before(until) - before(from)
}
