//! Golden traces: what was accepted of a scenario, and whether a trial still looks like it.
//!
//! * `thin`: a trace to the few points that draw it.
//! * `learn`: a tube from trials that differ.
//! * `file`: two small text files that can be read and compared like source.
//!
//! How wide tubes are and what that means stands in `docs/verdicts.md`.

mod file;
mod learn;
mod thin;

pub use file::{Accepted, BaselineError, Build, Features, Learned};
pub use learn::LearnError;

use crate::record::Verdict;
use crate::statistics::proportion::at_least;
use crate::tube::{Exceedance, Point, SIGNALS, Signal, Tube, response};
use platebench_trace::Row;
use serde::Serialize;

/// The probability below which so many trials outside a learned tube are no accident.
const REFUSED_BELOW: f64 = 0.05;
/// What rounding may add to a probability that is exactly there.
const ROUNDING: f64 = 1e-12;

/// The golden curves of a scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Golden {
    /// One per signal that is compared.
    pub tubes: Vec<Tube>,
    /// Spacing of the instants that are looked at beside the curves' own, ms.
    pub step_ms: Option<f64>,
    /// The share of trials that leave a learned tube although nothing has changed; `None` where no trial should.
    pub false_alarm_rate: Option<f64>,
}

/// What a trial is, held against golden curves.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Likeness {
    /// Inside every tube.
    Inside,
    /// Outside at least one; this is the worst.
    Outside(Exceedance),
    /// It starts or ends elsewhere, so that a part of either was not compared.
    Length {
        /// First and last instant of the trial, ms.
        trial_ms: [f64; 2],
        /// Of the golden curves, ms.
        golden_ms: [f64; 2],
    },
}

/// The trials of a scenario, held against golden curves.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// Over all trials.
    pub verdict: Verdict,
    /// How many trials were compared.
    pub trials: usize,
    /// How many were outside.
    pub outside: usize,
    /// Number of the trial that was the farthest outside, and where.
    pub worst: Option<(u32, Exceedance)>,
    /// Why it is not a pass, in a sentence.
    pub reason: Option<String>,
}

impl Golden {
    /// The curves of a trace as it is, with the usual tolerances. `None` for a trace without rows.
    pub fn of_rows(rows: &[Row]) -> Option<Self> {
        let points = |signal: &Signal| {
            response(signal, rows).into_iter().map(|(t_ms, value)| Point { t_ms, value, width: 0.0 }).collect()
        };
        let tube = |signal: &Signal| Tube {
            signal: signal.name.to_owned(),
            tolerance: signal.tolerance,
            points: points(signal),
        };
        (!rows.is_empty()).then(|| Self {
            tubes: SIGNALS.iter().map(tube).collect(),
            step_ms: None,
            false_alarm_rate: None,
        })
    }

    /// How a trial lies to the curves.
    pub fn likeness(&self, rows: &[Row]) -> Likeness {
        let exceedances = self.tubes.iter().filter_map(|tube| {
            let signal = Signal::named(&tube.signal)?;
            tube.worst(&response(signal, rows), self.step_ms)
        });
        if let Some(worst) =
            exceedances.reduce(|worst, other| if other.severity() > worst.severity() { other } else { worst })
        {
            return Likeness::Outside(worst);
        }
        let ms = |row: Option<&Row>| row.map_or(f64::NAN, |row| row.t_s * 1e3);
        let trial_ms = [ms(rows.first()), ms(rows.last())];
        let strange = self.tubes.iter().find(|tube| {
            let (from, to) = tube.span_ms();
            // Half a nanosecond, the precision of an instant, beside the tolerance.
            let near = |one: f64, other: f64| (one - other).abs() <= tube.tolerance.time_ms + 0.5e-6;
            !(near(from, trial_ms[0]) && near(to, trial_ms[1]))
        });
        match strange {
            Some(tube) => Likeness::Length { trial_ms, golden_ms: [tube.span_ms().0, tube.span_ms().1] },
            None => Likeness::Inside,
        }
    }

    /// Holds trials (number, rows) against the curves.
    ///
    /// Every trial has to lie inside; of a learned tube so many may lie outside as were declared, and it fails where as many would by chance with a probability
    /// of less than 5 %.
    pub fn compare<'a>(&self, trials: impl IntoIterator<Item = (u32, &'a [Row])>) -> Comparison {
        let mut comparison =
            Comparison { verdict: Verdict::Inconclusive, trials: 0, outside: 0, worst: None, reason: None };
        let mut odd = None;
        for (index, rows) in trials {
            comparison.trials += 1;
            match self.likeness(rows) {
                Likeness::Inside => {}
                Likeness::Outside(found) => {
                    comparison.outside += 1;
                    let is_worst =
                        comparison.worst.as_ref().is_none_or(|(_, worst)| found.severity() > worst.severity());
                    if is_worst {
                        comparison.worst = Some((index, found));
                    }
                }
                Likeness::Length { trial_ms: [from, to], golden_ms: [begin, end] } => {
                    odd.get_or_insert_with(|| {
                        format!("trial {index} runs from {from} to {to} ms, the baseline from {begin} to {end} ms")
                    });
                }
            }
        }
        let (verdict, reason) = self.decide(&comparison, odd);
        Comparison { verdict, reason, ..comparison }
    }

    fn decide(&self, comparison: &Comparison, odd: Option<String>) -> (Verdict, Option<String>) {
        let (outside, trials) = (comparison.outside as u32, comparison.trials as u32);
        let rate = self.false_alarm_rate.unwrap_or(0.0);
        let expected = rate * f64::from(trials);
        let said = match self.false_alarm_rate {
            Some(_) => format!("{outside} of {trials} trials lie outside, {expected:.1} would by chance"),
            None => format!("{outside} of {trials} trials lie outside"),
        };
        if trials == 0 {
            (Verdict::Inconclusive, Some("there is no trial to compare".to_owned()))
        } else if outside > 0 && at_least(outside, trials, rate) <= REFUSED_BELOW + ROUNDING {
            (Verdict::Fail, Some(said))
        } else if f64::from(outside) > expected {
            (Verdict::Inconclusive, Some(said))
        } else if odd.is_some() {
            (Verdict::Inconclusive, odd)
        } else {
            (Verdict::Pass, None)
        }
    }
}

#[cfg(test)]
mod tests;
