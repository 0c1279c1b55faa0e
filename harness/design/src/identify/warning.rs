//! Describes faults of recordings that the identification finds and takes into account.

use crate::identify::alignment::{Examined, MAX_ROTATION_DEG, pool_with_scatter};
use crate::identify::estimate::Estimate;
use crate::identify::fit::{FittedAlignment, ShiftedInputs};
use schemars::JsonSchema;
use serde::Serialize;

#[derive(Debug, Clone, PartialEq, Serialize, thiserror::Error, JsonSchema)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Warning {
    #[error("{}", describe_shift(*inputs, periods, *recordings, *of))]
    Shift {
        inputs: ShiftedInputs,
        /// Time by which the inputs act later than recorded, in periods.
        periods: Estimate,
        recordings: usize,
        of: usize,
    },
    #[error(
        "{recordings} of {of} recordings: the demodulator rotates W by {:.2}° (95 %: {:.2} to {:.2}); the fit contains \
         this rotation. Check the reference phase of the demodulator, because a controller holds Wq at 0 with the same \
         rotation",
        rotation_deg.value, rotation_deg.low, rotation_deg.high
    )]
    Rotation { rotation_deg: Estimate, recordings: usize, of: usize },
    #[error(
        "{recording}: the time stamps deviate by {deviation_us:.0} µs from equal spacing (standard deviation), and \
         equal spacing fits better; the fit uses it. Check whether the time is that of the sample or of the log"
    )]
    Jitter { recording: String, deviation_us: f64 },
    #[error(
        "{recording}: {rows} rows are missing, the first after {first_ms:.3} ms; the inputs changed in {unknown} of \
         the gaps, so W at their ends is a parameter of the fit. Check the log for lost rows"
    )]
    MissingRows {
        recording: String,
        rows: usize,
        /// Time of the last row before the first gap.
        first_ms: f64,
        /// Number of gaps in which the inputs changed.
        unknown: usize,
    },
}

fn describe_shift(inputs: ShiftedInputs, periods: &Estimate, recordings: usize, of: usize) -> String {
    let name = match inputs {
        ShiftedInputs::All => "inputs act",
        ShiftedInputs::Drive => "drive acts",
        ShiftedInputs::Frequency => "frequency acts",
    };
    let word = if periods.value > 0.0 { "later" } else { "earlier" };
    let distance = periods.scaled(periods.value.signum());
    let Estimate { value, low, high, .. } = distance;
    format!(
        "{recordings} of {of} recordings: the {name} {value:.3} periods (95 %: {low:.3} to {high:.3}) {word} than \
         recorded; the fit contains this shift. Check whether a row has the inputs from its time on and W at its time, \
         and whether the amplifier or the demodulator has a delay"
    )
}

pub(crate) fn warnings(examined: &[Examined]) -> Vec<Warning> {
    let alignments: Vec<&FittedAlignment> =
        examined.iter().filter_map(|each| each.aligned.as_ref()).map(|fit| &fit.alignment).collect();
    let of = examined.len();
    let mut warnings = Vec::new();
    for inputs in [ShiftedInputs::All, ShiftedInputs::Drive, ShiftedInputs::Frequency] {
        let shifts = alignments.iter().filter_map(|alignment| alignment.shift).filter(|shift| shift.0 == inputs);
        let shifts: Vec<Estimate> = shifts.map(|shift| shift.1).collect();
        let recordings = shifts.len();
        let pooled = pool_with_scatter(&shifts);
        warnings.extend(pooled.map(|periods| Warning::Shift { inputs, periods, recordings, of }));
    }
    let is_small = |alignment: &&&FittedAlignment| !alignment.is_mirrored;
    let angles = alignments.iter().filter(is_small).filter_map(|alignment| alignment.rotation_deg);
    let angles: Vec<Estimate> = angles.filter(|angle| angle.value.abs() <= MAX_ROTATION_DEG).collect();
    let pooled = pool_with_scatter(&angles);
    warnings.extend(pooled.map(|rotation_deg| Warning::Rotation { rotation_deg, recordings: angles.len(), of }));
    for each in examined {
        let recording = each.recording.name.clone();
        if let Some(deviation) = each.jitter_s {
            warnings.push(Warning::Jitter { recording: recording.clone(), deviation_us: deviation * 1e6 });
        }
        if let Some(first) = each.recording.gaps.first() {
            warnings.push(Warning::MissingRows {
                recording,
                rows: each.recording.gaps.iter().map(|gap| gap.missing_rows).sum(),
                first_ms: first.from * 1e3,
                unknown: each.recording.samples_after_unknown_inputs().len(),
            });
        }
    }
    warnings
}
