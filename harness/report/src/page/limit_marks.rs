//! Finds the limit, the judged window and the worst instant of an expectation in the rows of a
//! trial.

use super::curves;
use crate::chart::time_chart::TimeWindow;
use crate::format;
use platebench_model::record::{ExpectationRecord, Metric};
use platebench_model::trace::{Column, Row};

const LAST_OUTSIDE: &str = "last outside the band";

/// Limits of an expectation in the window that decided its verdict.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LimitMark {
    pub(crate) text: String,
    pub(crate) name: String,
    pub(crate) is_missed: bool,
    pub(crate) signal: Column,
    pub(crate) window: TimeWindow,
    pub(crate) levels: Vec<Level>,
    /// Meaning of `worst`, such as `last outside the band` or `mean`.
    pub(crate) kind: &'static str,
    pub(crate) worst: Vec<WorstPoint>,
}

/// A limit with the value `share · base + offset`, or `offset` if there is no base.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Level {
    pub(crate) base: Option<Column>,
    pub(crate) share: f64,
    pub(crate) offset: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct WorstPoint {
    pub(crate) t_ms: f64,
    pub(crate) value: f64,
    pub(crate) text: String,
}

impl LimitMark {
    /// `None` if no figure shows the metric, or if no window has a result.
    pub(crate) fn find(expectation: &ExpectationRecord, is_missed: bool, rows: &[Row]) -> Option<Self> {
        let signal = shown_signal(expectation)?;
        let in_window = |window: TimeWindow| {
            let start = rows.partition_point(|row| row.t_s * 1e3 < window.from_ms);
            // The row at the end belongs to the next window, except at the end of the trace.
            let is_last = rows.last().is_none_or(|row| row.t_s * 1e3 <= window.to_ms);
            let end = if is_last { rows.len() } else { rows.partition_point(|row| row.t_s * 1e3 < window.to_ms) };
            let inside = rows.get(start..end).filter(|inside| !inside.is_empty())?;
            let before = start.checked_sub(1).and_then(|index| rows.get(index));
            WindowResult::of(expectation, signal, before, inside).map(|result| (window, result))
        };
        let windows =
            expectation.windows_ms.iter().map(|[from_ms, to_ms]| TimeWindow { from_ms: *from_ms, to_ms: *to_ms });
        let margin = |result: &WindowResult| expectation.limit.margin(result.value, 0.0);
        let (window, worst) = windows.filter_map(in_window).min_by(|a, b| margin(&a.1).total_cmp(&margin(&b.1)))?;
        let point = |(t_ms, value): (f64, f64)| {
            let text = format!("{} {} at {} ms", format::number(value), curves::unit(signal), format::number(t_ms));
            WorstPoint { t_ms, value, text }
        };
        let unit = format::unit(expectation.metric);
        Some(Self {
            text: format!("{} {} {unit}", expectation.name, format::limit(expectation)).trim_end().to_owned(),
            name: if expectation.name.is_empty() { expectation.metric.to_string() } else { expectation.name.clone() },
            is_missed,
            signal,
            window,
            levels: worst.levels,
            kind: match expectation.metric {
                Metric::SettlingTime | Metric::RecoveryTime => LAST_OUTSIDE,
                Metric::StaticError => "mean",
                Metric::Ripple | Metric::RipplePercent => "extremes",
                Metric::FinalAmplitude | Metric::FrequencyError | Metric::QuadratureRatio => "end",
                _ => "worst",
            },
            worst: worst.points.into_iter().map(point).collect(),
        })
    }

    /// The judged window if it is short, otherwise the time around the worst instant.
    pub(crate) fn view(&self, whole: TimeWindow) -> Option<TimeWindow> {
        let around = |from_ms: f64, to_ms: f64| TimeWindow {
            from_ms: from_ms.max(whole.from_ms),
            to_ms: to_ms.min(whole.to_ms),
        };
        let worst = self.worst.first()?;
        // A settling or recovery time ends at its worst instant.
        let to_ms = if self.kind == LAST_OUTSIDE { worst.t_ms } else { self.window.to_ms };
        let span_ms = to_ms - self.window.from_ms;
        let view = if span_ms <= 0.3 * whole.span_ms() {
            let air = (0.2 * span_ms).max(1.0);
            around(self.window.from_ms - air, to_ms + air)
        } else {
            let half = (0.05 * whole.span_ms()).max(5.0);
            around(worst.t_ms - half, worst.t_ms + half)
        };
        (view.span_ms() > 0.0 && view.span_ms() < 0.8 * whole.span_ms()).then_some(view)
    }
}

struct WindowResult {
    value: f64,
    levels: Vec<Level>,
    /// Instants in ms, with values in the unit of the signal.
    points: Vec<(f64, f64)>,
}

fn shown_signal(expectation: &ExpectationRecord) -> Option<Column> {
    match expectation.metric {
        Metric::FrequencyError => Some(Column::Frequency),
        Metric::QuadratureRatio => Some(Column::Wq),
        Metric::DrivePeak | Metric::RestDrive => Some(Column::Drive),
        Metric::FinalAmplitude => Some(Column::Amplitude),
        Metric::SettlingTime
        | Metric::RecoveryTime
        | Metric::Overshoot
        | Metric::PeakDeviation
        | Metric::StaticError
        | Metric::Ripple
        | Metric::RipplePercent => match expectation.definition.signal.as_deref() {
            None | Some("amplitude_um") => Some(Column::Amplitude),
            Some("wd_um") => Some(Column::Wd),
            Some("wq_um") => Some(Column::Wq),
            Some(_) => None,
        },
        Metric::Repeatability
        | Metric::Saturated
        | Metric::LoopDelay
        | Metric::InstructionsPerStep
        | Metric::StepTime
        | Metric::Overruns
        | Metric::ShutdownTime
        | Metric::MissedReplies
        | Metric::TrialDifference
        | Metric::ReferenceDifference
        | Metric::ProtocolDifferences => None,
    }
}

impl WindowResult {
    /// `rows` are the rows of the window. `before` is the last row before the window.
    fn of(expectation: &ExpectationRecord, signal: Column, before: Option<&Row>, rows: &[Row]) -> Option<Self> {
        let (first, last) = (rows.first()?, rows.last()?);
        let point = |row: &Row| (row.t_s * 1e3, signal.value(row));
        let ends = format::limit_ends(expectation.limit);
        let constant = |end: &f64| Level { base: None, share: 0.0, offset: *end };
        let around_setpoint = |percent: f64| {
            [1.0, -1.0].map(|side| Level {
                base: Some(Column::Setpoint),
                share: 1.0 + side * percent / 100.0,
                offset: 0.0,
            })
        };
        let largest = |value: &dyn Fn(&Row) -> f64| rows.iter().max_by(|a, b| value(a).total_cmp(&value(b)));
        let deviation = |row: &Row| (signal.value(row) - row.setpoint_um).abs() / row.setpoint_um * 100.0;
        match expectation.metric {
            Metric::SettlingTime | Metric::RecoveryTime => {
                let percent = expectation.definition.band_percent?;
                let outside = rows.iter().rfind(|row| deviation(row) > percent)?;
                let (value, points) = ((outside.t_s - first.t_s) * 1e3, vec![point(outside)]);
                Some(Self { value, levels: around_setpoint(percent).to_vec(), points })
            }
            Metric::PeakDeviation => {
                let of = |row: &Row| if row.setpoint_um > 0.0 { deviation(row) } else { 0.0 };
                let worst = largest(&of)?;
                let levels = ends.iter().flat_map(|percent| around_setpoint(*percent)).collect();
                Some(Self { value: of(worst), levels, points: vec![point(worst)] })
            }
            Metric::StaticError => {
                let mean = time_weighted_mean(signal, rows)?;
                let mut levels: Vec<Level> = ends.iter().flat_map(|percent| around_setpoint(*percent)).collect();
                levels.push(constant(&mean));
                let value = (mean - last.setpoint_um).abs() / last.setpoint_um * 100.0;
                Some(Self { value, levels, points: vec![(last.t_s * 1e3, mean)] })
            }
            Metric::Overshoot => {
                let step = last.setpoint_um - before.map_or(0.0, |row| row.setpoint_um);
                let beyond = |row: &Row| (signal.value(row) - last.setpoint_um) / step * 100.0;
                let worst = largest(&beyond).filter(|_| step != 0.0)?;
                let level = |percent: &f64| constant(&(last.setpoint_um + percent / 100.0 * step));
                let levels = ends.iter().map(level).collect();
                Some(Self { value: beyond(worst), levels, points: vec![point(worst)] })
            }
            Metric::Ripple | Metric::RipplePercent => {
                let (high, low) = (largest(&|row| signal.value(row))?, largest(&|row| -signal.value(row))?);
                let value = signal.value(high) - signal.value(low);
                Some(Self { value, levels: Vec::new(), points: vec![point(high), point(low)] })
            }
            Metric::DrivePeak => {
                let worst = largest(&|row| row.drive_vpp)?;
                Some(Self {
                    value: worst.drive_vpp,
                    levels: ends.iter().map(constant).collect(),
                    points: vec![point(worst)],
                })
            }
            Metric::RestDrive => {
                let of = |row: &Row| if row.setpoint_um == 0.0 { row.drive_vpp } else { 0.0 };
                let worst = largest(&of)?;
                Some(Self { value: of(worst), levels: ends.iter().map(constant).collect(), points: vec![point(worst)] })
            }
            Metric::FinalAmplitude => {
                let value = signal.value(last);
                Some(Self { value, levels: ends.iter().map(constant).collect(), points: vec![point(last)] })
            }
            Metric::FrequencyError => {
                let level = |offset: f64| Level { base: Some(Column::Resonance), share: 1.0, offset };
                let levels = ends.iter().flat_map(|end| [level(*end), level(-end)]).collect();
                let value = (last.frequency_hz - last.resonance_hz).abs();
                Some(Self { value, levels, points: vec![point(last)] })
            }
            Metric::QuadratureRatio => {
                let level = |share: f64| Level { base: Some(Column::Wd), share, offset: 0.0 };
                let levels = ends.iter().flat_map(|end| [level(*end), level(-end)]).collect();
                Some(Self { value: (last.wq_um / last.wd_um).abs(), levels, points: vec![point(last)] })
            }
            _ => None,
        }
    }
}

fn time_weighted_mean(signal: Column, rows: &[Row]) -> Option<f64> {
    let (mut area, mut length) = (0.0, 0.0);
    for [left, right] in rows.array_windows() {
        area += (right.t_s - left.t_s) * f64::midpoint(signal.value(left), signal.value(right));
        length += right.t_s - left.t_s;
    }
    (length > 0.0).then(|| area / length)
}
