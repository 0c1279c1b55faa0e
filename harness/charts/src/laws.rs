//! Draws response time and accuracy of the control laws, at several loop delays and on plates that
//! a law does not expect.

use crate::measured_run::{ChartError, play_hosted};
use platebench_document::chart::marks::{
    Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks, logarithmic_extent, round_ticks,
};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use platebench_document::chart::{ScatterChart, ScatterPanel, ScatterPoint};
use platebench_document::{Block, ChartSection, Document, Table};
use platebench_engine::TrialResult;
use platebench_model::scenario::{Expectation, Metric, Scenario, Window, load};
use platebench_plate::{Model, Profile, Time};
use platebench_verdict::statistics::SampleSummary;
use platebench_verdict::{Measure, metrics};
use platebench_wire::LawId;
use std::path::Path;

const FILE: &str = "laws.csv";
const DRAWING: &str = "laws.svg";
const TABLE: &str = "laws.md";
/// Percentages below this value are drawn on the lower edge.
const SCALE_FLOOR: f64 = 1e-4;
const TABLE_FLOOR_PERCENT: f64 = 0.01;

pub fn build_chart(scenes: &[LawScenario]) -> Result<ChartSection, ChartError> {
    let pairs = LawId::ALL.into_iter().flat_map(|law| scenes.iter().enumerate().map(move |scene| (law, scene)));
    let results =
        pairs.map(|(law, (index, scene))| LawResult::measure(law, index, scene)).collect::<Result<Vec<_>, _>>()?;
    let table = result_table(scenes, &results);
    let svg = scatter_chart(scenes, &results).svg();
    let quiet: Vec<&LawScenario> = scenes.iter().filter(|scene| !scene.is_noisy()).collect();
    let variants = measure_variants(&quiet)?;
    let multiples = variants_chart(&quiet, &variants).svg();
    let files = [(FILE, csv_table(scenes, &results).csv()), (TABLE, table.markdown()), (DRAWING, svg.clone())];
    let variant_files = [(VARIANTS_CSV, variants_csv(&quiet, &variants)), (VARIANTS_DRAWING, multiples.clone())];
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into())];
    let caption = "Control laws: response time, static error, repeatability".to_owned();
    blocks.push(Block::figure(svg, caption));
    blocks.push(Block::Details(vec![Block::paragraph(VARIANTS_EXPLANATION)]));
    let caption = "Control laws: response time at loop delays of 0, 0.4 and 0.8 periods".to_owned();
    blocks.push(Block::figure(multiples, caption));
    blocks.push(Block::Table(table));
    blocks.extend([FILE, TABLE, VARIANTS_CSV].map(|name| Block::File(name.to_owned())));
    Ok(ChartSection {
        document: Document::new("Control laws: speed and accuracy of what is under test", blocks),
        files: files.into_iter().chain(variant_files).map(|(name, text)| (name.to_owned(), text)).collect(),
    })
}

const EXPLANATION: [&str; 3] = [
    "Every law with its own design, no loop delay, period of 1 ms, setpoint 2 µm, drive up to the plate's limit, on \
     the exact plate and the hosted rig. The response time runs from the setpoint step, or from the instant of the \
     force, to the last entry of |W| into 5 % of the setpoint. The static error is |mean over the last third − \
     setpoint|/setpoint.",
    "Repeatability is the standard deviation of that mean over trials with sensor noise; the response time of these \
     trials is the median. A law that does not stay in the band is at the right edge, with its name.",
    "Limits: a law needs two periods, for a sample and a second sample that checks it. The drive floor is the shortest \
     time with this drive limit, at resonance from the first instant on. The noise floor is the scatter of the mean of \
     the samples in the window. It is a lower limit for laws that follow the samples. A slow law, or one that ignores \
     the plate, scatters less.",
];

const VARIANTS_EXPLANATION: &str = "The same scenes at loop delays of 0, 0.4 and 0.8 control periods. The delay is \
    unknown to the law, or configured. In the two columns on the right the plate's gain is 10 % lower and higher than \
    the one that the law is designed for. A hollow point overshoots the setpoint by more than 20 %.";

fn result_table(scenes: &[LawScenario], results: &[LawResult]) -> Table {
    let name = |scene: &LawScenario| {
        if scene.is_noisy() { format!("repeatability: {}", scene.name) } else { scene.name.clone() }
    };
    let mut table = Table::new(std::iter::once("law".to_owned()).chain(scenes.iter().map(name)));
    let row = |law: LawId| {
        let own = results.iter().filter(|result| result.law == law);
        let cells = own.filter_map(|result| {
            let scene = scenes.get(result.scenario_index)?;
            let never = || "never".to_owned();
            Some(if scene.is_noisy() {
                result.repeatability_percent.map_or_else(never, format_percent)
            } else {
                let response = result.response_ms.map_or_else(never, |ms| format!("{ms:.2} ms"));
                let error = result.static_error_percent.map_or_else(|| "stopped".to_owned(), format_percent);
                format!("{response}, {error}")
            })
        });
        std::iter::once(law.name().to_owned()).chain(cells).collect::<Vec<_>>()
    };
    table.extend(LawId::ALL.map(row));
    table
}

fn format_percent(value: f64) -> String {
    if value < TABLE_FLOOR_PERCENT { format!("< {TABLE_FLOOR_PERCENT} %") } else { format!("{value:.2} %") }
}

fn csv_table(scenes: &[LawScenario], results: &[LawResult]) -> Table {
    let mut table = Table::new([
        "law",
        "scene",
        "scenario",
        "trials",
        "settled_trials",
        "response_ms",
        "static_error_percent",
        "repeatability_percent",
        "two_periods_ms",
        "drive_floor_ms",
        "noise_floor_percent",
    ]);
    for row in results {
        let Some(scene) = scenes.get(row.scenario_index) else { continue };
        let mut cells = vec![
            row.law.name().to_owned(),
            scene.name.clone(),
            scene.scenario.file.clone(),
            scene.trials.to_string(),
            row.settled_trials.to_string(),
        ];
        let numbers = [
            row.response_ms,
            row.static_error_percent,
            row.repeatability_percent,
            Some(2e3 * scene.scenario.controller.period.seconds()),
            scene.drive_limited_ms(),
            scene.is_noisy().then(|| scene.noise_floor_percent()),
        ];
        cells.extend(numbers.map(|value| value.map_or_else(String::new, |value| value.to_string())));
        table.push(cells);
    }
    table
}

fn scatter_chart(scenes: &[LawScenario], results: &[LawResult]) -> ScatterChart {
    let panel = |is_noisy: bool, y_label: &str, y: &dyn Fn(&LawResult) -> Option<f64>| {
        let own: Vec<(usize, &LawScenario)> =
            scenes.iter().enumerate().filter(|(_, scene)| scene.is_noisy() == is_noisy).collect();
        let point = |result: &LawResult| {
            Some(ScatterPoint {
                colour: law_number(result.law),
                shape: own.iter().position(|(number, _)| *number == result.scenario_index)?,
                x: result.response_ms,
                y: y(result)?,
            })
        };
        let floors = own.iter().filter(|_| is_noisy);
        ScatterPanel {
            y_label: y_label.to_owned(),
            floor: SCALE_FLOOR,
            shapes: own.iter().map(|(_, scene)| scene.name.clone()).collect(),
            points: results.iter().filter_map(point).collect(),
            x_limits: time_limits(&own),
            y_limits: floors
                .map(|(_, scene)| {
                    let nm = (scene.scenario.plate.noise_um_rms * 1e3).round();
                    (scene.noise_floor_percent(), format!("noise floor, {nm} nm"))
                })
                .collect(),
        }
    };
    ScatterChart {
        title: "Control laws: speed and accuracy".to_owned(),
        x_label: "response time to 5 %, ms".to_owned(),
        colours: LawId::ALL.map(|law| law.name().to_owned()).into(),
        edge_label: "never within 5 %".to_owned(),
        panels: vec![
            panel(false, "static error, %", &|result| result.static_error_percent),
            panel(true, "repeatability over trials, %", &|result| result.repeatability_percent),
        ],
    }
}

fn time_limits(scenes: &[(usize, &LawScenario)]) -> Vec<(f64, String)> {
    let mut limits: Vec<(f64, String)> = Vec::new();
    for (_, scene) in scenes {
        let periods = (2e3 * scene.scenario.controller.period.seconds(), "two periods".to_owned());
        let force = scene.scenario.conditions.at(Time::ZERO).finger_force_n;
        let name = if force > 0.0 { format!("drive floor, {force} N") } else { "drive floor, untouched".to_owned() };
        for limit in std::iter::once(periods).chain(scene.drive_limited_ms().map(|floor| (floor, name))) {
            if !limits.contains(&limit) {
                limits.push(limit);
            }
        }
    }
    limits
}

const BAND_PERCENT: f64 = 5.0;
const TRIALS: u32 = 20;
const QUICK_TRIALS: u32 = 4;
const FORCE_STEP_MS: f64 = 30.0;
const FORCE_STEP_N: f64 = 1.0;
const FINGER_N: f64 = 2.0;

pub struct LawScenario {
    pub(crate) name: String,
    pub(crate) scenario: Scenario,
    /// Measures the response time from the setpoint step or from a disturbance.
    response_expectation: Expectation,
    /// Measures the mean over the last third of the trial.
    window_mean_expectation: Expectation,
    pub(crate) trials: u32,
}

impl LawScenario {
    fn new(name: &str, mut scenario: Scenario, disturbed: Option<Time>, trials: u32) -> Self {
        let metric = if disturbed.is_some() { Metric::RecoveryTime } else { Metric::SettlingTime };
        let last_third = Window { from: Time::ZERO, to: scenario.duration }.last_third();
        let first_step = scenario.setpoint.next_point_after(Time::ZERO).unwrap_or(Time::ZERO);
        let response_window = Window { from: disturbed.unwrap_or(first_step), to: scenario.duration };
        let expected = |metric: Metric, judged: Window| Expectation {
            band_percent: BAND_PERCENT,
            from: disturbed,
            ..Expectation::for_window(metric, judged)
        };
        let (response, window_mean) = (expected(metric, response_window), expected(Metric::StaticError, last_third));
        // Because of this expectation, the trace has a row at every crossing of the band.
        scenario.expectations = vec![response.clone()];
        scenario.model = Model::Modal;
        Self {
            name: name.to_owned(),
            scenario,
            response_expectation: response,
            window_mean_expectation: window_mean,
            trials,
        }
    }

    pub(crate) fn is_noisy(&self) -> bool {
        self.scenario.plate.noise_um_rms > 0.0
    }

    /// Response time in ms (`None` if |W| does not stay in the band), and overshoot in percent.
    pub(crate) fn response(&self, played: &TrialResult) -> (Option<f64>, f64) {
        let response = metric_value(&self.response_expectation, played);
        let peak = played.trace_rows.iter().map(|row| row.amplitude_um).fold(0.0, f64::max);
        (response, ((peak / self.scenario.setpoint.range().1 - 1.0) * 100.0).max(0.0))
    }

    fn window_samples(&self) -> f64 {
        let Window { from, to } = Window { from: Time::ZERO, to: self.scenario.duration }.last_third();
        (to.seconds() - from.seconds()) / self.scenario.controller.period.seconds()
    }

    /// Standard deviation of the mean of the window's samples due to noise, % of the setpoint.
    pub(crate) fn noise_floor_percent(&self) -> f64 {
        self.scenario.plate.noise_um_rms / self.scenario.setpoint.range().1 / self.window_samples().sqrt() * 100.0
    }

    /// Shortest response time that the drive limit allows, at resonance in the initial conditions.
    pub(crate) fn drive_limited_ms(&self) -> Option<f64> {
        let scenario = &self.scenario;
        let mode = scenario.plate.mode(&scenario.conditions.at(Time::ZERO));
        let share = 1.0 - BAND_PERCENT / 100.0;
        mode.min_rise_time(scenario.setpoint.range().1, share, scenario.plate.drive_limit_vpp).map(|floor| floor * 1e3)
    }
}

pub fn load_law_scenarios(folder: &Path, is_quick: bool) -> Result<Vec<LawScenario>, ChartError> {
    let read = |file: &str| load(&folder.join(file), file).map_err(ChartError::from);
    let [resonant, detuned, pressed] = [13, 14, 16].map(|figure| read(&format!("paper/fig{figure}-closed-loop.toml")));
    let (resonant, detuned, pressed) = (resonant?, detuned?, pressed?);
    let mut finger = resonant.clone();
    finger.conditions.finger_force_n = Profile::constant(FINGER_N);
    let mut stepped = resonant.clone();
    let step = Time::from_ms(FORCE_STEP_MS).unwrap_or_default();
    stepped.conditions.finger_force_n = Profile::Hold(vec![(Time::ZERO, 0.0), (step, FORCE_STEP_N)]);
    let mut scenes = vec![
        LawScenario::new("Fig. 13: at resonance", resonant, None, 1),
        LawScenario::new("Fig. 14: 9 K off", detuned, None, 1),
        LawScenario::new("Fig. 16: 9 K off, 2 N", pressed, None, 1),
        LawScenario::new("2 N at resonance", finger, None, 1),
        LawScenario::new("1 N comes down", stepped, Some(step), 1),
    ];
    for level in [3, 10, 32] {
        let scenario = read(&format!("laws/noise-{level}nm-dq-pi.toml"))?;
        let trials = if is_quick { QUICK_TRIALS } else { TRIALS };
        scenes.push(LawScenario::new(&format!("Fig. 16, {level} nm of noise"), scenario, None, trials));
    }
    Ok(scenes)
}

pub(crate) struct LawResult {
    pub(crate) law: LawId,
    pub(crate) scenario_index: usize,
    /// Median over trials. `None` if at least half of the trials do not stay in the band.
    pub(crate) response_ms: Option<f64>,
    pub(crate) settled_trials: u32,
    /// |mean over trials − setpoint|/setpoint. `None` if the controller stopped in a trial.
    pub(crate) static_error_percent: Option<f64>,
    pub(crate) repeatability_percent: Option<f64>,
}

impl LawResult {
    pub(crate) fn measure(law: LawId, scenario_index: usize, scene: &LawScenario) -> Result<Self, ChartError> {
        let what = format!("{}, {}", scene.name, law.name());
        let (mut responses, mut means) = (Vec::new(), Vec::new());
        for index in 0..scene.trials {
            let played = play_hosted(&what, &scene.scenario, law, index)?;
            responses.push(metric_value(&scene.response_expectation, &played).unwrap_or(f64::INFINITY));
            means.extend(metric_value(&scene.window_mean_expectation, &played));
        }
        let whole = SampleSummary::of(&means).filter(|summary| summary.count == responses.len());
        let settled = responses.iter().filter(|response| response.is_finite()).count() as u32;
        Ok(Self {
            law,
            scenario_index,
            response_ms: median(responses).filter(|response| response.is_finite()),
            settled_trials: settled,
            static_error_percent: whole.map(|summary| summary.mean.abs()),
            repeatability_percent: whole.filter(|summary| summary.count > 1).map(|summary| summary.deviation),
        })
    }
}

fn metric_value(expectation: &Expectation, played: &TrialResult) -> Option<f64> {
    match metrics::measure(expectation, &played.trace_rows, &played.telemetry) {
        Measure::Value(value) => Some(value),
        Measure::Interval(_) | Measure::Samples(_) | Measure::Missing(_) | Measure::Undefined(_) => None,
    }
}

/// If the number of values is even, returns the larger of the two middle values.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

const VARIANTS_CSV: &str = "law-variants.csv";
const VARIANTS_DRAWING: &str = "law-variants.svg";
/// Loop delays in control periods.
const DELAYS: [f64; 3] = [0.0, 0.4, 0.8];
const LARGE_OVERSHOOT_PERCENT: f64 = 20.0;

/// Deviation of the played scenario from the design of the law.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Variant {
    name: &'static str,
    is_delay_known: bool,
    /// Gain of the plate relative to the gain for which the law is designed.
    gain_factor: f64,
}

const VARIANTS: [Variant; 4] = [
    Variant { name: "delay unknown", is_delay_known: false, gain_factor: 1.0 },
    Variant { name: "delay known", is_delay_known: true, gain_factor: 1.0 },
    Variant { name: "delay known, gain −10 %", is_delay_known: true, gain_factor: 0.9 },
    Variant { name: "delay known, gain +10 %", is_delay_known: true, gain_factor: 1.1 },
];

impl Variant {
    fn scenario(&self, scene: &Scenario, delay_periods: f64) -> Scenario {
        let mut scenario = scene.clone();
        let delay = Time::from_seconds(scene.controller.period.seconds() * delay_periods).unwrap_or_default();
        scenario.controller.loop_delay = delay;
        scenario.controller.design_delay = if self.is_delay_known { delay } else { Time::ZERO };
        scenario.controller.design_plate = Some(scene.plate.clone());
        scenario.plate.gain *= self.gain_factor;
        scenario
    }
}

struct VariantResult {
    law: LawId,
    /// Indices into the scenes, [`VARIANTS`] and [`DELAYS`].
    at: [usize; 3],
    /// `None` if |W| does not stay in the band.
    response_ms: Option<f64>,
    overshoot_percent: f64,
}

/// Plays one trial of each variant, so the scenes must not have noise.
fn measure_variants(scenes: &[&LawScenario]) -> Result<Vec<VariantResult>, ChartError> {
    let mut results = Vec::new();
    for (scene_index, scene) in scenes.iter().enumerate() {
        for (variant_index, variant) in VARIANTS.iter().enumerate() {
            for (delay_index, delay) in DELAYS.iter().enumerate() {
                let scenario = variant.scenario(&scene.scenario, *delay);
                for law in LawId::ALL {
                    let what = format!("{}, {}, {}", scene.name, variant.name, law.name());
                    let played = play_hosted(&what, &scenario, law, 0)?;
                    let (response_ms, overshoot_percent) = scene.response(&played);
                    let at = [scene_index, variant_index, delay_index];
                    results.push(VariantResult { law, at, response_ms, overshoot_percent });
                }
            }
        }
    }
    Ok(results)
}

fn variants_csv(scenes: &[&LawScenario], results: &[VariantResult]) -> String {
    let columns = ["law", "scene", "delay_known", "plate_gain", "delay_periods", "response_ms", "overshoot_percent"];
    let mut table = Table::new(columns);
    for result in results {
        let [scene, variant, delay] = result.at;
        let (Some(scene), Some(variant), Some(delay)) = (scenes.get(scene), VARIANTS.get(variant), DELAYS.get(delay))
        else {
            continue;
        };
        table.push(vec![
            result.law.name().to_owned(),
            scene.name.clone(),
            variant.is_delay_known.to_string(),
            variant.gain_factor.to_string(),
            delay.to_string(),
            result.response_ms.map_or_else(String::new, |ms| ms.to_string()),
            format!("{:.2}", result.overshoot_percent),
        ]);
    }
    table.csv()
}

/// Width and height, CSS pixels.
const VARIANT_PANEL: Point = (216.0, 190.0);
const VARIANT_RADIUS: f64 = 2.6;

/// A panel per scene and variant. A law that does not stay in the band is at the upper edge.
fn variants_chart(scenes: &[&LawScenario], results: &[VariantResult]) -> PanelChart {
    let times = logarithmic_extent(results.iter().filter_map(|result| result.response_ms));
    let (low, high) = times.map_or((0.5, 20.0), |(low, high)| (low / 1.3, high * 1.3));
    let never = high * 1.25;
    // Points of different laws are side by side, so that equal values stay visible.
    let step = 0.8 / LawId::ALL.len() as f64;
    let point = |result: &VariantResult| {
        let law = law_number(result.law);
        let x = result.at[2] as f64 + 0.5 + (law as f64 - (LawId::ALL.len() as f64 - 1.0) / 2.0) * step;
        let y = result.response_ms.filter(|ms| ms.is_finite() && *ms > 0.0).unwrap_or(never);
        let shape = if result.overshoot_percent > LARGE_OVERSHOOT_PERCENT { Shape::Ring } else { Shape::Disc };
        Mark::point(Role::Series(law), (x, y), shape, VARIANT_RADIUS)
    };
    let delays = DELAYS.map(|delay| delay.to_string());
    let ticks = |_: &Axis| Ticks::new(round_ticks(&(low..high)), true, |value| value.to_string());
    // The names of scene and variant are two lines, because one would be wider than the panel.
    let panel = |at: [usize; 2], scene: &LawScenario, variant: &Variant| {
        let points = results.iter().filter(|result| result.at[..2] == at).map(point);
        let edge = Mark::Limit { role: Role::Mark, at: AxisValue::Y(never), text: None };
        Panel {
            title: scene.name.clone(),
            x: PanelAxis::names("loop delay in control periods", &delays, usize::MAX),
            y: PanelAxis::new(variant.name, Scale::Logarithmic, low..high * 1.5, ticks),
            cells: Vec::new(),
            marks: [edge].into_iter().chain(points).collect(),
        }
    };
    let mut panels = Vec::new();
    for (row, scene) in scenes.iter().enumerate() {
        panels.extend(VARIANTS.iter().enumerate().map(|(column, variant)| panel([row, column], scene, variant)));
    }
    let hollow = format!("hollow: overshoot above {LARGE_OVERSHOOT_PERCENT} %");
    let rest = [
        LegendEntry::new(Symbol::Point(Role::Axis, Shape::Ring), hollow),
        LegendEntry::new(Symbol::Line(Role::Mark), "never within 5 %"),
    ];
    PanelChart {
        title: "Control laws: loop delay, and plates that the law does not expect (response time to 5 %, ms)"
            .to_owned(),
        has_heading: true,
        panel_size: VARIANT_PANEL,
        columns: VARIANTS.len(),
        panels,
        legend: LegendEntry::series(LawId::ALL.map(LawId::name)).chain(rest).collect(),
    }
}

fn law_number(law: LawId) -> usize {
    LawId::ALL.iter().position(|known| *known == law).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn svg(results: &[VariantResult]) -> String {
        let scenes = load_law_scenarios(&platebench_test_kit::scenario_path(""), true).unwrap();
        variants_chart(&[&scenes[0]], results).svg()
    }

    fn result(law: usize, response_ms: Option<f64>) -> VariantResult {
        VariantResult { law: LawId::ALL[law], at: [0, 0, 1], response_ms, overshoot_percent: LARGE_OVERSHOOT_PERCENT }
    }

    /// Heights of the discs of a law. The last disc is that of the legend.
    fn heights(svg: &str, law: usize) -> Vec<i64> {
        let circles = svg.split("<circle").filter(|part| part.contains(&format!("f-series-{law}\"")));
        circles.map(|part| part.split("cy=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap()).collect()
    }

    #[test]
    fn a_longer_time_lies_higher_and_no_time_highest() {
        let svg = svg(&[result(0, Some(1.0)), result(0, Some(10.0)), result(1, None)]);
        let (times, none) = (heights(&svg, 0), heights(&svg, 1));
        assert!(times[0] > times[1] && times[1] > none[0], "{times:?} {none:?}");
        assert!(svg.contains(">0.4<") && svg.contains(">never within 5 %<") && svg.contains(">5<"), "{svg}");
    }

    #[test]
    fn a_large_overshoot_is_a_ring() {
        let large = VariantResult { overshoot_percent: LARGE_OVERSHOOT_PERCENT + 0.1, ..result(1, Some(2.0)) };
        let svg = svg(&[large]);
        assert!(svg.contains("s-series-1"), "{svg}");
        assert_eq!(heights(&svg, 1).len(), 1, "only in the legend");
    }
}
