//! Measures what the last row of the window shows.

use super::measurement::{Measurement, SignalPoint, UndefinedValue};
use super::spec::{DriveBound, Levels, LimitMarkSpec, MetricSpec, Unit};
use crate::trace::Column;

const fn end_mark(signal: Column, levels: Levels) -> LimitMarkSpec {
    LimitMarkSpec { signal: Some(signal), levels, label: "end" }
}

pub(super) const FREQUENCY_ERROR: MetricSpec = MetricSpec {
    name: "frequency_error_hz",
    unit: Unit::Hertz,
    definition: "|excitation − true resonance| in the last row",
    on_real_plate: Some(UndefinedValue::UnknownResonance),
    mark: Some(end_mark(Column::Frequency, Levels::Around(Column::Resonance))),
    measure: |input| {
        let row = input.last_row()?;
        let value = (row.frequency_hz - row.resonance_hz).abs();
        Ok(Measurement::value_at(value, [SignalPoint::of(row, |row| row.frequency_hz)]))
    },
    ..MetricSpec::DEFAULT
};

pub(super) const QUADRATURE_RATIO: MetricSpec = MetricSpec {
    name: "quadrature_ratio",
    unit: Unit::Ratio,
    definition: "|Wq/Wd| in the last row",
    mark: Some(end_mark(Column::Wq, Levels::TimesColumn(Column::Wd))),
    measure: |input| {
        let row = input.last_row()?;
        if row.wd_um == 0.0 {
            return Err(UndefinedValue::NoInPhaseComponent);
        }
        Ok(Measurement::value_at((row.wq_um / row.wd_um).abs(), [SignalPoint::of(row, |row| row.wq_um)]))
    },
    ..MetricSpec::DEFAULT
};

pub(super) const FINAL_AMPLITUDE: MetricSpec = MetricSpec {
    name: "final_amplitude_um",
    unit: Unit::Micrometres,
    definition: "|W| in the last row",
    drive_bound: DriveBound::Largest,
    mark: Some(end_mark(Column::Amplitude, Levels::Constant)),
    measure: |input| {
        let row = input.last_row()?;
        Ok(Measurement::value_at(row.amplitude_um, [SignalPoint::of(row, |row| row.amplitude_um)]))
    },
    ..MetricSpec::DEFAULT
};
