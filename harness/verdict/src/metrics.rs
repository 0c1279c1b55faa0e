//! Measures one trial from its trace.
//!
//! The runner adds a row on either side of every crossing of an expected band. Between rows the
//! plate's signals count as linear, which changes a settling time by less than 1 ns (some µs for a
//! band that the run did not know). The controller's samples are known at control instants only: a
//! time measured from them is an interval.

mod band;
mod measure;
mod ripple;
mod shutdown;
mod signal;
mod steps;
mod window;
mod window_rows;

pub use measure::Measure;
pub use steps::setpoint_steps;

use platebench_record::{MissingValue, Telemetry, UndefinedValue};
use platebench_scenario::{Expectation, Metric, Window};
use platebench_trace::{Flags, Row};
use signal::MetricSignal;
use window::{flagged_share, window_mean_ratio};
use window_rows::{window_rows, window_rows_with_previous};

/// The worst window decides. [`Metric::Repeatability`] gives the window mean in percent of the
/// setpoint. A trial with a command that its trace cannot show has no number.
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
    // Only these two may credit a stop (at rest nothing overshoots), and only one that the
    // controller made: if it was lost, the bench applied the 0 V.
    let allows_stop = matches!(expectation.metric, Metric::ShutdownTime | Metric::MissedReplies);
    if last.flags.contains(Flags::SAFE) && !(allows_stop && telemetry.ended.is_none()) {
        return Measure::Missing(MissingValue::NotRunning);
    }
    let sensed = last.flags.contains(Flags::SENSED);
    if let Some(unknown) = unknown_on_a_real_plate(expectation.metric).filter(|_| sensed) {
        return Measure::Undefined(unknown);
    }
    let signal = MetricSignal::from_name(expectation.signal, sensed);
    let measures = expectation.windows.iter().map(|window| {
        let measure = measure_window(expectation, window, signal, rows, telemetry);
        (severity(expectation, &measure), measure)
    });
    let worst = measures.reduce(|worst, other| if other.0 > worst.0 { other } else { worst });
    worst.map_or(Measure::Undefined(UndefinedValue::EmptyWindow), |(_, measure)| measure)
}

/// Value by its distance from the limit, undefined, value that breaks the limit, missing.
fn severity(expectation: &Expectation, measure: &Measure) -> (u8, f64) {
    let (lowest, highest) = expectation.range();
    match measure {
        Measure::Missing(_) => (3, 0.0),
        Measure::Undefined(_) => (1, 0.0),
        Measure::Samples(_) => (0, 0.0),
        Measure::Value(value) | Measure::Interval([_, value]) => {
            // Only the static error has a sign.
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
) -> Measure {
    let window_mean = || window_mean_ratio(signal, window, rows);
    let value_or_undefined = |value: Result<f64, UndefinedValue>| value.map_or_else(Measure::Undefined, Measure::Value);
    let inside = window_rows(window, rows);
    let at_end =
        |value: &dyn Fn(&Row) -> Measure| inside.last().map_or(Measure::Undefined(UndefinedValue::EmptyWindow), value);
    let in_force = || window_rows_with_previous(window, rows);
    let ripple = || ripple::ripple_um(inside, |row| signal.value_in(row)).ok_or(UndefinedValue::EmptyWindow);
    let setpoint = || inside.first().map(|row| row.setpoint_um).filter(|setpoint| *setpoint > 0.0);
    match expectation.metric {
        Metric::SettlingTime => band::settling_time(expectation, window, signal, rows),
        Metric::RecoveryTime => band::recovery_time(expectation, window, signal, rows),
        Metric::Overshoot => band::overshoot(window, signal, rows),
        Metric::PeakDeviation => band::peak_deviation(window, signal, rows),
        Metric::StaticError => value_or_undefined(window_mean().map(|ratio| (ratio - 1.0) * 100.0)),
        Metric::Repeatability => value_or_undefined(window_mean().map(|ratio| ratio * 100.0)),
        Metric::FrequencyError => at_end(&|row| Measure::Value((row.frequency_hz - row.resonance_hz).abs())),
        Metric::QuadratureRatio => at_end(&|row| {
            if row.wd_um == 0.0 {
                Measure::Undefined(UndefinedValue::NoInPhaseComponent)
            } else {
                Measure::Value((row.wq_um / row.wd_um).abs())
            }
        }),
        Metric::FinalAmplitude => at_end(&|row| Measure::Value(row.amplitude_um)),
        Metric::DrivePeak => Measure::Value(in_force().iter().map(|row| row.drive_vpp).fold(0.0, f64::max)),
        Metric::Saturated => Measure::Value(flagged_share(in_force(), Flags::SATURATED) * 100.0),
        Metric::LoopDelay => value_or_undefined(telemetry.loop_delay_us.ok_or(UndefinedValue::NotReported)),
        Metric::InstructionsPerStep => {
            value_or_undefined(telemetry.instructions_worst.ok_or(UndefinedValue::NotReported))
        }
        Metric::ReferenceDifference => {
            value_or_undefined(telemetry.reference_difference_percent.ok_or(UndefinedValue::NotReported))
        }
        Metric::ProtocolDifferences => {
            let differences = telemetry.protocol_differences.as_ref().ok_or(UndefinedValue::NotReported);
            value_or_undefined(differences.map(|differences| differences.len() as f64))
        }
        Metric::Overruns => count_flagged(inside, Flags::OVERRUN),
        Metric::ShutdownTime => shutdown::shutdown_time(window, rows),
        Metric::MissedReplies => count_flagged(inside, Flags::CONTROL | Flags::LINK_LOST),
        Metric::Ripple => value_or_undefined(ripple()),
        Metric::RipplePercent => {
            value_or_undefined(ripple().and_then(|um| Ok(um / setpoint().ok_or(UndefinedValue::ZeroSetpoint)? * 100.0)))
        }
        Metric::TrialDifference => {
            let control = inside.iter().filter(|row| row.flags.contains(Flags::CONTROL));
            Measure::Samples(control.map(|row| signal.value_in(row)).collect())
        }
        Metric::RestDrive => {
            let highest = in_force().iter().map(|row| row.drive_vpp).reduce(f64::max);
            value_or_undefined(highest.ok_or(UndefinedValue::EmptyWindow))
        }
    }
}

/// A real plate's controller reports only what it knows.
const fn unknown_on_a_real_plate(metric: Metric) -> Option<UndefinedValue> {
    match metric {
        Metric::FrequencyError => Some(UndefinedValue::UnknownResonance),
        Metric::RecoveryTime => Some(UndefinedValue::UnknownDisturbance),
        Metric::Overruns
        | Metric::MissedReplies
        | Metric::LoopDelay
        | Metric::ReferenceDifference
        | Metric::ProtocolDifferences => Some(UndefinedValue::NotInLoop),
        Metric::InstructionsPerStep => Some(UndefinedValue::UncountedInstructions),
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

fn count_flagged(rows: &[Row], flags: Flags) -> Measure {
    Measure::Value(rows.iter().filter(|row| row.flags.contains(flags)).count() as f64)
}

#[cfg(test)]
mod tests;
