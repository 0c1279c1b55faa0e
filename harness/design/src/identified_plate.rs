//! Formats an identification as tables next to the paper's values, and as a plate file, and
//! combines its errors with the uncertainty budget of the measurement.

use crate::identify::residuals::is_explained_by_chance;
use crate::identify::{Estimate, FrequencyStep, Identification, IdentifiedHeating, RecordingFit, VoltageStep};
use platebench_document::{Block, Document, Table};
use platebench_verdict::uncertainty::{Budget, CombinedUncertainty, EvaluationError, TypeA};
use schemars::JsonSchema;
use serde::Serialize;
use std::fmt::Write as _;

/// Rows of Table I as printed: Vpp, K1 in pm/V, τ1 in ms.
const TABLE_I: [[f64; 3]; 4] =
    [[120.0, 7108.0, 1.85], [208.0, 6547.0, 1.71], [312.0, 6620.0, 1.94], [370.0, 7103.0, 2.07]];
const TABLE_I_MEANS: [f64; 2] = [6980.0, 1.88];
/// K2 and τ2 in s, from the end of section IV of the paper.
const TABLE_II: [f64; 2] = [1.812e-3, 1.624e-3];
/// Slope from two resonances of the paper: 202 995 rad/s at 24 °C and 202 450 rad/s at 33 °C.
const SLOPE_HZ_PER_K: f64 = -9.638;
/// Force in N and σ/σ0: at 1.5 N the amplitude is halved (Fig. 3).
const FINGER_DAMPING: [f64; 2] = [1.5, 2.0];

/// A table with its heading and the notes below it.
struct Section {
    title: &'static str,
    table: Table,
    notes: Vec<String>,
}

impl Section {
    fn new(title: &'static str, header: &[&str]) -> Self {
        Self { title, table: Table::new(header.iter().copied()), notes: Vec::new() }
    }
}

/// Omits tables without rows. `uncertainties` may be empty.
pub fn document(title: &str, found: &Identification, uncertainties: &[ParameterUncertainty]) -> Document {
    let sections = [
        plate_table(found),
        voltage_table(found),
        frequency_table(found),
        residuals_table(found),
        uncertainty_table(uncertainties),
    ];
    let sections = sections.into_iter().filter(|section| !section.table.rows.is_empty());
    let blocks = sections.flat_map(|Section { title, table, notes }| {
        [Block::heading(title), Block::Table(table)].into_iter().chain(notes.into_iter().map(Block::Paragraph))
    });
    Document::new(title, blocks.collect())
}

/// Formats value and half of the interval as `1.88 ± 0.02`. A dash means a missing estimate.
fn format_estimate(estimate: Option<Estimate>, factor: f64, decimals: usize) -> String {
    estimate.map_or("–".to_owned(), |estimate| {
        let estimate = estimate.scaled(factor);
        format!("{:.decimals$} ± {:.decimals$}", estimate.value, (estimate.high - estimate.low) / 2.0)
    })
}

/// Standard deviation in percent of the mean; empty for fewer than two values.
fn format_scatter(values: &[f64]) -> String {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    if values.len() < 2 {
        String::new()
    } else {
        format!("{:.1} %", (squares / (count - 1.0)).sqrt() / mean.abs() * 100.0)
    }
}

fn estimates_of_steps<T>(group: &[&T], of: impl Fn(&T) -> NamedEstimates<'_>, index: usize) -> Vec<(String, Estimate)> {
    let named = group.iter().filter_map(|step| of(step));
    named.filter_map(|(recording, pair)| Some((recording.to_owned(), *pair.get(index)?))).collect()
}

type NamedEstimates<'a> = Option<(&'a str, [Estimate; 2])>;

/// Label of the row, values of the paper, and the steps.
type VoltageRow<'a> = (String, Option<[f64; 2]>, Vec<&'a VoltageStep>);

fn voltage_table(found: &Identification) -> Section {
    let title = "Table I: steps of the voltage, K1 in pm/V and τ1 in ms";
    let header = [
        "Vpp",
        "steps",
        "K1 ARX",
        "K1 instruments",
        "K1 direct",
        "scatter",
        "paper",
        "τ1 ARX",
        "τ1 instruments",
        "τ1 direct",
        "scatter",
        "paper",
    ];
    let mut section = Section::new(title, &header);
    let mut steps: Vec<&VoltageStep> = found.voltage_steps.iter().collect();
    steps.sort_by(|a, b| a.force_n.total_cmp(&b.force_n).then(a.vpp.total_cmp(&b.vpp)));
    let mut rows: Vec<VoltageRow<'_>> = Vec::new();
    // K1 and τ1 depend on the force.
    for steps in steps.chunk_by(|a, b| a.force_n == b.force_n) {
        let force = steps.first().map_or(0.0, |first| first.force_n);
        let label = |drive: &str| if force == 0.0 { drive.to_owned() } else { format!("{drive}, {force} N") };
        let paper = |values: [f64; 2]| Some(values).filter(|_| force == 0.0);
        let before = rows.len();
        for group in steps.chunk_by(|a, b| (a.vpp - b.vpp).abs() <= 1.0) {
            let vpp = group.iter().map(|step| step.vpp).sum::<f64>() / group.len() as f64;
            let printed = TABLE_I.iter().find(|row| (row[0] - vpp).abs() <= 1.0);
            let printed = printed.and_then(|row| paper([row[1], row[2]]));
            rows.push((label(&format!("{vpp:.0}")), printed, group.to_vec()));
        }
        if rows.len() > before + 1 {
            rows.push((label("all"), paper(TABLE_I_MEANS), steps.to_vec()));
        }
    }
    for (level, paper, group) in rows {
        let mut row = vec![level, group.len().to_string()];
        for (index, factor, decimals, printed) in [(0, 1e6, 0, 0), (1, 1e3, 3, 2)] {
            let direct = estimates_of_steps(&group, |step| Some((&step.recording, step.direct?)), index);
            for estimates in [
                estimates_of_steps(&group, |step| Some((&step.recording, step.least_squares?)), index),
                estimates_of_steps(&group, |step| Some((&step.recording, step.instruments?)), index),
                direct.clone(),
            ] {
                row.push(format_estimate(Estimate::pool_by_recording(&estimates), factor, decimals));
            }
            row.push(format_scatter(&direct.iter().map(|(_, estimate)| estimate.value).collect::<Vec<_>>()));
            row.push(paper.map_or(String::new(), |paper| format!("{:.printed$}", paper[index])));
        }
        section.table.push(row);
    }
    section.notes.push(
        "The paper's printed mean of K1, 6980 pm/V, is not the mean of its four trials, 6844.5 pm/V; \
         neither is that of τ1, 1.88 ms (1.8925 ms). Its trials scatter by ±5 % and ±6 %."
            .to_owned(),
    );
    if let Some(change) = found.gain_change_percent {
        let Estimate { value, low, high, .. } = change;
        section.notes.push(format!(
            "Linearity: from the lowest to the highest drive K1 changes by {value:.2} % \
             (95 %: {low:.2} to {high:.2} %)."
        ));
    }
    section
}

fn frequency_table(found: &Identification) -> Section {
    let title = "Table II: steps of the frequency at constant Wd, K2 and τ2 in ms";
    let header = [
        "Δω from, rad/s",
        "to",
        "steps",
        "Wd deviates",
        "K2 ARX",
        "K2 instruments",
        "τ2 ARX",
        "τ2 instruments",
        "τ direct",
        "K2/τ2",
        "paper",
    ];
    let mut section = Section::new(title, &header);
    let mut steps: Vec<&FrequencyStep> = found.frequency_steps.iter().collect();
    steps.sort_by(|a, b| b.detuning.total_cmp(&a.detuning));
    let mut rows: Vec<(String, String, &[&FrequencyStep])> = Vec::new();
    // Steps are in one row if their detunings differ by less than a quarter of a step.
    for group in steps.chunk_by(|a, b| (a.detuning - b.detuning).abs() < 0.25 * (a.detuning - a.from_detuning).abs()) {
        let count = group.len() as f64;
        let mean = |of: &dyn Fn(&FrequencyStep) -> f64| group.iter().map(|step| of(step)).sum::<f64>() / count;
        rows.push((
            format!("{:.0}", mean(&|step| step.from_detuning)),
            format!("{:.0}", mean(&|step| step.detuning)),
            group,
        ));
    }
    if rows.len() > 1 {
        rows.push(("all".to_owned(), String::new(), &steps));
    }
    for (from, to, group) in rows {
        let strays = group.iter().map(|step| step.wd_percent).fold(0.0, f64::max);
        let pooled = |of: fn(&FrequencyStep) -> Option<[Estimate; 2]>, index| {
            let named = estimates_of_steps(group, |step| Some((&step.recording, of(step)?)), index);
            Estimate::pool_by_recording(&named)
        };
        let squares = |index| pooled(|step| step.least_squares, index);
        let direct = pooled(|step| Some([step.direct?; 2]), 0);
        let (k2, tau2) = (pooled(|step| step.instruments, 0), pooled(|step| step.instruments, 1));
        let quotient = k2.zip(tau2).map_or(String::new(), |(k2, tau2)| format!("{:.3}", k2.value / tau2.value));
        section.table.push(vec![
            from,
            to,
            group.len().to_string(),
            format!("{strays:.1} %"),
            format_estimate(squares(0), 1e3, 3),
            format_estimate(k2, 1e3, 3),
            format_estimate(squares(1), 1e3, 3),
            format_estimate(tau2, 1e3, 3),
            format_estimate(direct, 1e3, 3),
            quotient,
            format!("{:.3}, {:.3}", TABLE_II[0] * 1e3, TABLE_II[1] * 1e3),
        ]);
    }
    section.notes.push(
        "By equation 19 K2 = τ2 at the resonance, and by theory τ2 = τ1; the paper prints K2/τ2 = 1.116 and a τ2 14 % \
         below its τ1. Off resonance a step of Δω also disturbs Wd. While a loop corrects it, Wq/Wd is faster than the \
         plate: an ARX model of Wq/Wd alone gives a τ2 that is too short, but the right K2. The direct fit uses \
         the drive and is not affected."
            .to_owned(),
    );
    section
}

fn plate_table(found: &Identification) -> Section {
    let mut section = Section::new("The plate, with intervals of 95 %", &["quantity", "value", "interval", "paper"]);
    let mut row = |name: &str, estimate: Option<Estimate>, factor: f64, decimals: usize, paper: String| {
        if let Some(estimate) = estimate.map(|estimate| estimate.scaled(factor)) {
            let interval = format!("{:.decimals$} to {:.decimals$}", estimate.low, estimate.high);
            section.table.push(vec![name.to_owned(), format!("{:.decimals$}", estimate.value), interval, paper]);
        }
    };
    row("K1, pm/V", found.gain_um_per_vpp, 1e6, 1, format!("{:.0}", TABLE_I_MEANS[0]));
    row("τ1, ms", found.time_constant_s, 1e3, 4, format!("{:.2}", TABLE_I_MEANS[1]));
    row("K2, ms", found.frequency_gain_s, 1e3, 4, format!("{:.3}", TABLE_II[0] * 1e3));
    row("τ2 (direct), ms", found.frequency_time_constant_s, 1e3, 4, format!("{:.3}", TABLE_II[1] * 1e3));
    row("resonance, Hz", found.resonance_hz, 1.0, 2, "32307.6".to_owned());
    row("resonance per kelvin, Hz/K", found.slope_hz_per_k, 1.0, 3, format!("{SLOPE_HZ_PER_K}"));
    row("resonance per newton, Hz/N", found.shift_hz_per_n, 1.0, 2, String::new());
    for (force, ratio) in &found.damping_ratio {
        let paper = if *force == FINGER_DAMPING[0] { format!("{}", FINGER_DAMPING[1]) } else { String::new() };
        row(&format!("σ/σ0 at {force} N"), Some(*ratio), 1.0, 4, paper);
    }
    if let Some(second) = found.second_mode {
        row("second mode: resonance, Hz", Some(second.resonance_hz), 1.0, 2, String::new());
        row("second mode: τ, ms", Some(second.time_constant_s), 1e3, 4, String::new());
        row("second mode: gain, pm/V", Some(second.gain_um_per_vpp), 1e6, 1, String::new());
    }
    if let Some(heating) = found.heating {
        row("self-heating: shift of the resonance, Hz/µm²", Some(heating.shift_hz_per_um2), 1.0, 4, String::new());
        row("self-heating: time constant, s", Some(heating.time_constant_s), 1.0, 4, String::new());
    }
    row("inputs act later than recorded, periods", found.input_shift_periods, 1.0, 4, String::new());
    row("rotation of W by the demodulator, °", found.demodulator_rotation_deg, 1.0, 3, String::new());
    let excitation = |whole: &RecordingFit| whole.resonance_hz.value + whole.detuning_hz.value;
    if let Some(first) = found.recordings.first() {
        row(&format!("detuning of {:.1} Hz, Hz", excitation(first)), Some(first.detuning_hz), 1.0, 2, String::new());
    }
    section
}

fn residuals_table(found: &Identification) -> Section {
    let header = ["recording", "samples", "noise, nm", "Ljung-Box p", "K1, pm/V", "τ, ms", "resonance, Hz"];
    let mut section = Section::new("Direct fits: residuals", &header);
    for whole in &found.recordings {
        let white = whole.whiteness.map_or("–".to_owned(), |white| {
            format!("{:.3}{}", white.p_value, if white.is_rejected() { " not white" } else { "" })
        });
        section.table.push(vec![
            whole.recording.clone(),
            whole.samples.to_string(),
            format!("{:.2}", whole.noise_um * 1e3),
            white,
            format_estimate(Some(whole.gain_um_per_vpp), 1e6, 0),
            format_estimate(Some(whole.time_constant_s), 1e3, 3),
            format_estimate(Some(whole.resonance_hz), 1.0, 2),
        ]);
    }
    let coloured =
        found.recordings.iter().filter(|whole| whole.whiteness.is_some_and(|white| white.is_rejected())).count();
    let tested = found.recordings.iter().filter(|whole| whole.whiteness.is_some()).count();
    if coloured > 0 {
        let meaning = if is_explained_by_chance(coloured, tested) {
            "chance explains this number."
        } else {
            "chance does not explain this number. The plate changed in a way that the model does not include, and the \
             intervals are too narrow."
        };
        section
            .notes
            .push(format!("The residuals of {coloured} of {tested} recordings are not white at 1 %: {meaning}"));
    }
    section.notes.extend(
        found.undetermined.iter().map(|name| format!("{name} does not determine the parameters and was left out.")),
    );
    section
}

/// Values of a plate file that no recording determines.
#[derive(Debug, Clone, PartialEq)]
pub struct PlateFileDetails {
    pub name: String,
    pub source: String,
    pub reference_temperature_c: f64,
    /// Drive limit; `None` means the highest drive of the recordings.
    pub limit_vpp: Option<f64>,
    pub slope_hz_per_k: Option<f64>,
}

/// Intervals become comments and `[uncertainty]`. `None` without gain, time constant or resonance.
pub fn plate_file(found: &Identification, named: &PlateFileDetails) -> Option<String> {
    let line = |key: &str, estimate: Estimate, factor: f64, decimals: usize| {
        let Estimate { value, low, high, .. } = estimate.scaled(factor);
        format!("{key} = {value:.decimals$}    # 95 %: {low:.decimals$} to {high:.decimals$}\n")
    };
    let quoted = |text: &str| text.replace('\\', "\\\\").replace('"', "\\\"").replace(char::is_control, " ");
    let inconsistencies = found
        .inconsistencies
        .iter()
        .map(|inconsistency| format!("# DOUBTFUL: {}\n", inconsistency.to_string().replace('\n', " ")));
    let mut text = inconsistencies.collect::<String>();
    text.extend(
        found.warnings.iter().map(|warning| format!("# WARNING: {}\n", warning.to_string().replace('\n', " "))),
    );
    let _ = writeln!(text, "name = \"{}\"\nsource = \"{}\"\n\n[mode]", quoted(&named.name), quoted(&named.source));
    text += &line("resonance_hz", found.resonance_hz?, 1.0, 3);
    let _ = writeln!(text, "reference_temperature_c = {:?}", named.reference_temperature_c);
    let slope = match (found.slope_hz_per_k, named.slope_hz_per_k) {
        (Some(slope), _) => line("resonance_slope_hz_per_k", slope, 1.0, 4),
        (None, Some(given)) => format!("resonance_slope_hz_per_k = {given:?}    # given, not identified\n"),
        (None, None) => "resonance_slope_hz_per_k = 0.0    # not identified: no change of temperature\n".to_owned(),
    };
    text += &slope;
    text += &line("time_constant_ms", found.time_constant_s?, 1e3, 5);
    text += &line("gain_um_per_vpp", found.gain_um_per_vpp?, 1.0, 8);
    if let Some(second) = found.second_mode {
        text += "\n[second_mode]\n";
        text += &line("resonance_hz", second.resonance_hz, 1.0, 3);
        text += &line("time_constant_ms", second.time_constant_s, 1e3, 5);
        text += &line("gain_um_per_vpp", second.gain_um_per_vpp, 1.0, 8);
    }
    if let Some(heating) = found.heating {
        text += &heating_lines(found, named, heating);
    }
    if !found.damping_ratio.is_empty() {
        let points = found.damping_ratio.iter().map(|(force, ratio)| format!(", [{force:?}, {:.5}]", ratio.value));
        let points = points.collect::<Vec<_>>().concat();
        let errors = found
            .damping_ratio
            .iter()
            .map(|(force, ratio)| format!("{force} N ± {:.5}", (ratio.high - ratio.low) / 2.0));
        let errors: Vec<String> = errors.collect();
        let _ = writeln!(text, "\n[finger]\ndamping_ratio = [[0.0, 1.0]{points}]    # 95 %: {}", errors.join(", "));
        text += &found.shift_hz_per_n.map_or(String::new(), |shift| line("resonance_shift_hz_per_n", shift, 1.0, 4));
    }
    let (limit, comment) =
        named.limit_vpp.map_or((found.highest_vpp, "    # highest drive of the recordings"), |limit| (limit, ""));
    let _ = writeln!(text, "\n[drive]\nlimit_vpp = {limit:?}{comment}");
    let _ = writeln!(text, "\n[sensor]\nnoise_um_rms = {:.6}    # of the residuals", found.noise_um);
    let floor = if found.inconsistencies.is_empty() {
        String::new()
    } else {
        format!("    # doubtful: at least {DOUBTFUL_PERCENT:.0} %, and the intervals above are too narrow")
    };
    let _ = writeln!(
        text,
        "\n[uncertainty]{floor}\ngain_percent = {:.2}\ntime_constant_percent = {:.2}",
        uncertainty_percent(found, found.gain_um_per_vpp?),
        uncertainty_percent(found, found.time_constant_s?)
    );
    Some(text)
}

/// Lines of `[heating]`. The rise is the shift per µm² divided by the shift per kelvin. Without the
/// shift per kelvin, the lines are a comment.
fn heating_lines(found: &Identification, named: &PlateFileDetails, heating: IdentifiedHeating) -> String {
    let slope = found.slope_hz_per_k.map(|slope| slope.value).or(named.slope_hz_per_k).unwrap_or(0.0);
    let (shift, seconds) = (heating.shift_hz_per_um2, heating.time_constant_s);
    let rise = shift.value / slope;
    if !(rise.is_finite() && rise >= 0.0) {
        return format!(
            "\n# Self-heating: {:.5} Hz/µm² with {:.4} s; \
             [heating] needs the slope of the resonance, with the same sign\n",
            shift.value, seconds.value
        );
    }
    format!(
        "\n[heating]\nrise_k_per_um2 = {rise:.6}    # {:.5} Hz/µm² over {slope:.4} Hz/K\n\
         time_constant_s = {:.5}    # 95 %: {:.5} to {:.5}\n",
        shift.value, seconds.value, seconds.low, seconds.high
    )
}

/// At least [`DOUBTFUL_PERCENT`] if the recordings are inconsistent, because the interval assumes
/// one plate and white noise.
fn uncertainty_percent(found: &Identification, estimate: Estimate) -> f64 {
    let floor = if found.inconsistencies.is_empty() { 0.0 } else { DOUBTFUL_PERCENT };
    reach_percent(estimate).max(floor)
}

/// Uncertainty that covers a damping that changes by 5 % per µm up to 4 µm.
const DOUBTFUL_PERCENT: f64 = 25.0;

/// Larger half of the interval in percent of the value, rounded up to two decimals.
fn reach_percent(Estimate { value, low, high, .. }: Estimate) -> f64 {
    ((high - value).max(value - low) / value * 1e4).ceil() / 100.0
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ParameterUncertainty {
    pub quantity: String,
    pub value: f64,
    pub interval: [f64; 2],
    pub combined: CombinedUncertainty,
}

/// Omits parameters without budget or estimate. The fit gives a repeatability that is not stated.
pub fn parameter_uncertainties(
    found: &Identification,
    budget: &Budget,
) -> Result<Vec<ParameterUncertainty>, EvaluationError> {
    let parameters = [
        ("gain_um_per_vpp", found.gain_um_per_vpp),
        ("time_constant_s", found.time_constant_s),
        ("resonance_hz", found.resonance_hz),
        ("slope_hz_per_k", found.slope_hz_per_k),
    ];
    let budgeted =
        parameters.into_iter().filter_map(|(name, estimate)| Some((name, estimate?, budget.quantity(name)?)));
    budgeted
        .map(|(name, estimate, quantity)| {
            let Estimate { value, error, freedom, .. } = estimate;
            let observed = TypeA { standard: error, degrees_of_freedom: freedom };
            let combined = quantity.combine(value, Some(observed), budget.coverage)?;
            let interval = [value - combined.expanded, value + combined.expanded];
            Ok(ParameterUncertainty { quantity: name.to_owned(), value, interval, combined })
        })
        .collect()
}

fn uncertainty_table(parameters: &[ParameterUncertainty]) -> Section {
    let header = ["quantity", "value", "u", "ν", "k", "U", "largest contribution"];
    let mut section = Section::new("Combined and expanded uncertainty", &header);
    section.table.extend(parameters.iter().map(|ParameterUncertainty { quantity, value, combined, .. }| {
        let largest = combined.contributions.iter().max_by(|a, b| a.standard.total_cmp(&b.standard));
        [
            quantity.clone(),
            format!("{value:.6e}"),
            format!("{:.3e}", combined.standard),
            combined.degrees_of_freedom.map_or_else(|| "∞".to_owned(), |freedom| format!("{freedom:.1}")),
            format!("{:.2}", combined.coverage_factor),
            format!("{:.3e}", combined.expanded),
            largest.map_or_else(String::new, |largest| format!("{:.3e}, {}", largest.standard, largest.source)),
        ]
    }));
    section
}
