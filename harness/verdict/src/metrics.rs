//! Measures one trial from its trace.
//!
//! The engine adds a row on either side of every crossing of an expected band. The plate's signals
//! count as linear between rows. This changes a settling time by less than 1 ns, or by some µs if
//! the run did not know the band. The controller's samples are known at control instants only, so a
//! time measured from them is an interval.

mod band;
mod measure;
mod shutdown;
mod signal;
mod steps;
mod window;

pub use measure::Measure;
pub use steps::setpoint_steps;

use platebench_model::record::{MissingValue, Telemetry, UndefinedValue};
use platebench_model::scenario::{Expectation, Metric, Window};
use platebench_model::trace::{Flags, Row};
use signal::MetricSignal;
use window::{flagged_share, ripple_um, window_mean_ratio, window_rows, window_rows_with_previous};

/// The worst window decides. [`Metric::Repeatability`] gives the window mean in percent of the
/// setpoint. A trial with a NaN or infinite drive command has no number.
pub fn measure(expectation: &Expectation, rows: &[Row], telemetry: &Telemetry) -> Measure {
    let measure = measure_trace(expectation, rows, telemetry);
    let has_number = !matches!(measure, Measure::Missing(_) | Measure::Undefined(_));
    if telemetry.not_finite.is_some() && has_number && expectation.metric != Metric::MissedReplies {
        return Measure::Missing(MissingValue::NonFiniteDrive);
    }
    measure
}

fn measure_trace(expectation: &Expectation, rows: &[Row], telemetry: &Telemetry) -> Measure {
    let Some(last) = rows.last() else { return Measure::Undefined(UndefinedValue::EmptyTrace) };
    // A stopped controller has a value of these two metrics only, because a plate at rest cannot
    // overshoot. A controller that ended has none: the bench applied the 0 V.
    let allows_stop = matches!(expectation.metric, Metric::ShutdownTime | Metric::MissedReplies);
    if telemetry.ended.is_some() || (last.flags.contains(Flags::SAFE) && !allows_stop) {
        return Measure::Missing(MissingValue::NotRunning);
    }
    let sensed = last.flags.contains(Flags::SENSED);
    if let Some(unknown) = unknown_on_a_real_plate(expectation.metric).filter(|_| sensed) {
        return Measure::Undefined(unknown);
    }
    let signal = MetricSignal::from_name(expectation.signal, sensed);
    let measures = expectation.windows.iter().map(|window| {
        let measure = measure_window(expectation, window, signal, rows, telemetry).unwrap_or_else(Measure::Undefined);
        (severity(expectation, &measure), measure)
    });
    let worst = measures.reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
    worst.map_or(Measure::Undefined(UndefinedValue::EmptyWindow), |(_, measure)| measure)
}

/// Rank (0 good, 1 undefined, 2 breaks the limit, 3 missing) and distance from the limit.
fn severity(expectation: &Expectation, measure: &Measure) -> (u8, f64) {
    let (lowest, highest) = expectation.range();
    match measure {
        Measure::Missing(_) => (3, 0.0),
        Measure::Undefined(_) => (1, 0.0),
        Measure::Samples(_) => (0, 0.0),
        Measure::Value(value) | Measure::Interval([_, value]) => {
            // The static error has a sign; other values are not negative.
            let exceedance = (lowest - value.abs()).max(value.abs() - highest);
            (if exceedance > 0.0 { 2 } else { 0 }, exceedance)
        }
    }
}

fn measure_window(
    expectation: &Expectation,
    window: &Window,
    signal: MetricSignal,
    rows: &[Row],
    telemetry: &Telemetry,
) -> Result<Measure, UndefinedValue> {
    let window_mean = || window_mean_ratio(signal, window, rows);
    let inside = window_rows(window, rows);
    let last = || inside.last().ok_or(UndefinedValue::EmptyWindow);
    let in_force = || window_rows_with_previous(window, rows);
    let ripple = || ripple_um(signal, inside).ok_or(UndefinedValue::EmptyWindow);
    let reported = |value: Option<f64>| value.ok_or(UndefinedValue::NotReported);
    let value = match expectation.metric {
        Metric::SettlingTime => return band::settling_time(expectation, window, signal, rows),
        Metric::RecoveryTime => return band::recovery_time(expectation, window, signal, rows),
        Metric::ShutdownTime => return Ok(shutdown::shutdown_time(window, rows)),
        Metric::TrialDifference => {
            let control = inside.iter().filter(|row| row.flags.contains(Flags::CONTROL));
            return Ok(Measure::Samples(control.map(|row| signal.value_in(row)).collect()));
        }
        Metric::Overshoot => band::overshoot(window, signal, rows)?,
        Metric::PeakDeviation => band::peak_deviation(window, signal, rows)?,
        Metric::StaticError => (window_mean()? - 1.0) * 100.0,
        Metric::Repeatability => window_mean()? * 100.0,
        Metric::FrequencyError => {
            let row = last()?;
            (row.frequency_hz - row.resonance_hz).abs()
        }
        Metric::QuadratureRatio => {
            let row = last()?;
            if row.wd_um == 0.0 {
                return Err(UndefinedValue::NoInPhaseComponent);
            }
            (row.wq_um / row.wd_um).abs()
        }
        Metric::FinalAmplitude => last()?.amplitude_um,
        Metric::DrivePeak => in_force().iter().map(|row| row.drive_vpp).fold(0.0, f64::max),
        Metric::RestDrive => {
            let highest = in_force().iter().map(|row| row.drive_vpp).reduce(f64::max);
            highest.ok_or(UndefinedValue::EmptyWindow)?
        }
        Metric::Saturated => flagged_share(in_force(), Flags::SATURATED) * 100.0,
        Metric::LoopDelay => reported(telemetry.loop_delay_us)?,
        Metric::InstructionsPerStep => reported(telemetry.instructions_worst)?,
        Metric::StepTime => reported(telemetry.step_time.map(|step| step.longest_percent))?,
        Metric::ReferenceDifference => reported(telemetry.reference_difference_percent)?,
        Metric::ProtocolDifferences => reported(telemetry.protocol_differences.as_ref().map(|all| all.len() as f64))?,
        Metric::Overruns => count_flagged(inside, Flags::OVERRUN),
        Metric::MissedReplies => count_flagged(inside, Flags::CONTROL | Flags::LINK_LOST),
        Metric::Ripple => ripple()?,
        Metric::RipplePercent => {
            let um = ripple()?;
            let setpoint = inside.first().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
            um / setpoint.ok_or(UndefinedValue::ZeroSetpoint)? * 100.0
        }
    };
    Ok(Measure::Value(value))
}

const fn unknown_on_a_real_plate(metric: Metric) -> Option<UndefinedValue> {
    match metric {
        Metric::FrequencyError => Some(UndefinedValue::UnknownResonance),
        Metric::RecoveryTime => Some(UndefinedValue::UnknownDisturbance),
        Metric::Overruns
        | Metric::MissedReplies
        | Metric::LoopDelay
        | Metric::ReferenceDifference
        | Metric::ProtocolDifferences => Some(UndefinedValue::NotInLoop),
        Metric::InstructionsPerStep | Metric::StepTime => Some(UndefinedValue::UncountedInstructions),
        Metric::SettlingTime
        | Metric::StaticError
        | Metric::Repeatability
        | Metric::Overshoot
        | Metric::PeakDeviation
        | Metric::QuadratureRatio
        | Metric::FinalAmplitude
        | Metric::DrivePeak
        | Metric::Saturated
        | Metric::RipplePercent
        | Metric::Ripple
        | Metric::RestDrive
        | Metric::TrialDifference
        | Metric::ShutdownTime => None,
    }
}

fn count_flagged(rows: &[Row], flags: Flags) -> f64 {
    rows.iter().filter(|row| row.flags.contains(flags)).count() as f64
}

#[cfg(test)]
mod tests;
