//! Control laws side by side: response time against static error and against repeatability, one point for each law and scene, with what nobody can beat.

use super::{ChartError, ChartFolder, ChartSection, quote_csv_field};
use platebench_plate::{Profile, Tier, Time};
use platebench_report::chart::{ScatterChart, ScatterPanel, ScatterPoint};
use platebench_report::page::PageBlock;
use platebench_report::text::Table;
use platebench_rig::{FaultInjector, HostedLink, Session};
use platebench_runner::CancelToken;
use platebench_runner::trial::{self, TrialSpec};
use platebench_scenario::{Aggregation, Expectation, Limit, Metric, Scenario, Window, load};
use platebench_verdict::statistics::SampleSummary;
use platebench_verdict::{Measure, metrics};
use platebench_wire::LawId;
use std::fmt::Write as _;
use std::path::Path;

const FILE: &str = "laws.csv";
const DRAWING: &str = "laws.svg";
const TABLE: &str = "laws.md";
/// Half width of the band of response times, percent.
const BAND_PERCENT: f64 = 5.0;
/// Trials behind noise.
const TRIALS: u32 = 20;
const QUICK_TRIALS: u32 = 4;
/// When the force steps, and to what.
const FORCE_STEP_MS: f64 = 30.0;
const FORCE_STEP_N: f64 = 1.0;
const FINGER_N: f64 = 2.0;
/// Smallest percentage that is told apart in the drawing, and in tables.
const SCALE_FLOOR: f64 = 1e-4;
const TABLE_FLOOR_PERCENT: f64 = 0.01;

/// What all laws are played through.
pub(crate) struct LawScenario {
    name: String,
    scenario: Scenario,
    /// The response: from the setpoint step, or from a disturbance at an instant.
    response_expectation: Expectation,
    /// Mean over the last third.
    window_mean_expectation: Expectation,
    trials: u32,
}

impl LawScenario {
    fn new(name: &str, mut scenario: Scenario, disturbed: Option<Time>, trials: u32) -> Self {
        let metric = if disturbed.is_some() { Metric::RecoveryTime } else { Metric::SettlingTime };
        let last_third = Window { from: Time::ZERO, to: scenario.duration }.last_third();
        let first_step = scenario.setpoint.next_point_after(Time::ZERO).unwrap_or(Time::ZERO);
        let response_window = Window { from: disturbed.unwrap_or(first_step), to: scenario.duration };
        let expected = |metric: Metric, judged: Window| Expectation {
            name: metric.name().to_owned(),
            windows: vec![judged],
            after: None,
            metric,
            limit: Limit::AtMost(0.0),
            tolerance_percent: 0.0,
            paper: None,
            requirement: None,
            confidence: 0.95,
            aggregation: Aggregation::default_for(metric),
            band_percent: BAND_PERCENT,
            from: disturbed,
            signal: "amplitude_um",
        };
        let (response, window_mean) = (expected(metric, response_window), expected(Metric::StaticError, last_third));
        // The crossings of this band are rows of the trace, on the exact plate.
        scenario.expectations = vec![response.clone()];
        scenario.tier = Tier::Modal;
        Self {
            name: name.to_owned(),
            scenario,
            response_expectation: response,
            window_mean_expectation: window_mean,
            trials,
        }
    }

    fn is_noisy(&self) -> bool {
        self.scenario.plate.noise_um_rms > 0.0
    }

    /// Periods of the window.
    fn window_samples(&self) -> f64 {
        let Window { from, to } = Window { from: Time::ZERO, to: self.scenario.duration }.last_third();
        (to.seconds() - from.seconds()) / self.scenario.controller.period.seconds()
    }

    /// Percent by which the mean of the window's samples scatters by itself.
    fn noise_floor_percent(&self) -> f64 {
        self.scenario.plate.noise_um_rms / self.scenario.setpoint.range().1 / self.window_samples().sqrt() * 100.0
    }

    /// ms in which the drive can bring the plate into the band at all, at resonance, in the surroundings of the start.
    fn drive_limited_ms(&self) -> Option<f64> {
        let scenario = &self.scenario;
        let mode = scenario.plate.mode(&scenario.conditions.at(Time::ZERO));
        let share = 1.0 - BAND_PERCENT / 100.0;
        mode.min_rise_time(scenario.setpoint.range().1, share, scenario.plate.drive_limit_vpp).map(|floor| floor * 1e3)
    }
}

/// The scenes below `folder`, read and changed, nothing played yet.
pub(crate) fn load_law_scenarios(folder: &Path, is_quick: bool) -> Result<Vec<LawScenario>, ChartError> {
    let read = |file: &str| load(&folder.join(file), file).map_err(|fault| ChartError::Scenarios(vec![fault]));
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

/// What a law made of a scene.
struct LawResult {
    law: LawId,
    scenario_index: usize,
    /// ms, the median over trials; none where half of them or more never stay in the band.
    response_ms: Option<f64>,
    /// Trials that stay in the band.
    settled_trials: u32,
    /// |mean over trials − setpoint|/setpoint; none where the controller was not there at the end.
    static_error_percent: Option<f64>,
    /// Standard deviation over trials.
    repeatability_percent: Option<f64>,
}

impl LawResult {
    fn run(law: LawId, number: usize, scene: &LawScenario) -> Result<Self, ChartError> {
        let failed = |why: String| ChartError::NotPlayed { file: format!("{}, {}", scene.name, law.name()), why };
        let mut session =
            Session::open(FaultInjector::new(HostedLink::new())).map_err(|error| failed(error.to_string()))?;
        let (mut responses, mut means) = (Vec::new(), Vec::new());
        for index in 0..scene.trials {
            let order = TrialSpec { scenario: &scene.scenario, law, index, wire_time: false, own_clock: false };
            let played = trial::play(&mut session, &order, &CancelToken::never(), None);
            let played = played.ok_or_else(|| failed("the trial was given up".to_owned()))?;
            if let Some(lost) = played.link_error {
                return Err(failed(lost.to_string()));
            }
            let measured = |expectation| match metrics::measure(expectation, &played.trace_rows, &played.telemetry) {
                Measure::Value(value) => Some(value),
                Measure::Interval(_) | Measure::Missing(_) | Measure::Undefined(_) => None,
            };
            responses.push(measured(&scene.response_expectation).unwrap_or(f64::INFINITY));
            means.extend(measured(&scene.window_mean_expectation));
        }
        let whole = SampleSummary::of(&means).filter(|summary| summary.count == responses.len());
        let settled = responses.iter().filter(|response| response.is_finite()).count() as u32;
        Ok(Self {
            law,
            scenario_index: number,
            response_ms: median(responses).filter(|response| response.is_finite()),
            settled_trials: settled,
            static_error_percent: whole.map(|summary| summary.mean.abs()),
            repeatability_percent: whole.filter(|summary| summary.count > 1).map(|summary| summary.deviation),
        })
    }
}

/// The upper one of the two in the middle.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Plays every law through every scene and draws what came of it.
pub(crate) fn build_chart(scenes: &[LawScenario], folder: &ChartFolder) -> Result<ChartSection, ChartError> {
    let pairs = LawId::ALL.into_iter().flat_map(|law| scenes.iter().enumerate().map(move |scene| (law, scene)));
    let found =
        pairs.map(|(law, (number, scene))| LawResult::run(law, number, scene)).collect::<Result<Vec<_>, _>>()?;
    let table = result_table(scenes, &found);
    folder.write(FILE, &format_csv(scenes, &found))?;
    folder.write(TABLE, &format_markdown(&table))?;
    let svg = scatter_chart(scenes, &found).svg()?;
    folder.write(DRAWING, &svg)?;
    let summary = format_console(&table);
    let mut blocks: Vec<PageBlock> = EXPLANATION.map(|text| PageBlock::Text(text.to_owned())).into();
    let caption = "Control laws: response time, static error, repeatability".to_owned();
    blocks.push(PageBlock::Drawings(vec![(svg, caption)]));
    blocks.push(PageBlock::Table(table));
    blocks.extend([FILE, TABLE].map(|name| PageBlock::File(name.to_owned())));
    Ok(ChartSection { blocks, summary })
}

const EXPLANATION: [&str; 3] = [
    "Every law with its own design, no loop delay, period of 1 ms, setpoint 2 µm, drive up to the plate's limit, on the exact plate and the hosted rig. The response time runs from the setpoint step to the last entry of |W| into \
     5 % of the setpoint; where 1 N comes down on the swinging plate, from then on. The static error is |mean over the last third − setpoint|/setpoint.",
    "Repeatability is the standard deviation of that mean over trials behind sensor noise, the response time there the median. Who never stays in the band stands at the right edge and is named.",
    "Limits: a law needs a sample and a second one to check it by, two periods; the drive floor is what the drive's limit leaves, at resonance from the first instant on; the noise floor is the \
     scatter of the mean of the samples in the window, below which no law comes that follows them. One that does not look at the plate, or slowly, has less.",
];

/// ms and percent of a law in a scene, and percent behind noise.
fn result_table(scenes: &[LawScenario], found: &[LawResult]) -> Table {
    let name = |scene: &LawScenario| {
        if scene.is_noisy() { format!("repeatability: {}", scene.name) } else { scene.name.clone() }
    };
    let head = std::iter::once("law".to_owned()).chain(scenes.iter().map(name)).collect();
    let row = |law: LawId| {
        let own = found.iter().filter(|found| found.law == law);
        let cells = own.filter_map(|found| {
            let scene = scenes.get(found.scenario_index)?;
            let never = || "never".to_owned();
            Some(if scene.is_noisy() {
                found.repeatability_percent.map_or_else(never, format_percent)
            } else {
                let response = found.response_ms.map_or_else(never, |ms| format!("{ms:.2} ms"));
                let error = found.static_error_percent.map_or_else(|| "stopped".to_owned(), format_percent);
                format!("{response}, {error}")
            })
        });
        std::iter::once(law.name().to_owned()).chain(cells).collect()
    };
    Table { header: head, rows: LawId::ALL.into_iter().map(row).collect() }
}

fn format_percent(value: f64) -> String {
    if value < TABLE_FLOOR_PERCENT { format!("< {TABLE_FLOOR_PERCENT} %") } else { format!("{value:.2} %") }
}

fn format_markdown(table: &Table) -> String {
    let line = |fields: &[String]| format!("| {} |\n", fields.join(" | "));
    let rows: String = table
        .rows
        .iter()
        .map(|row| match row.split_first() {
            Some((law, rest)) => line(&[&[format!("`{law}`")], rest].concat()),
            None => String::new(),
        })
        .collect();
    format!("{}|{}\n{rows}", line(&table.header), "---|".repeat(table.header.len()))
}

fn format_console(table: &Table) -> String {
    let mut text = String::new();
    // Writing into a string does not fail.
    for (column, scene) in table.header.iter().enumerate().skip(1) {
        let _ = writeln!(text, "{scene}");
        for row in &table.rows {
            if let (Some(law), Some(field)) = (row.first(), row.get(column)) {
                let _ = writeln!(text, "  {law:<16}{field}");
            }
        }
    }
    text
}

fn format_csv(scenes: &[LawScenario], found: &[LawResult]) -> String {
    let mut text = "law,scene,scenario,trials,settled_trials,response_ms,static_error_percent,repeatability_percent,two_periods_ms,drive_floor_ms,noise_floor_percent\n".to_owned();
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    for row in found {
        let Some(scene) = scenes.get(row.scenario_index) else { continue };
        let cells = [
            row.response_ms,
            row.static_error_percent,
            row.repeatability_percent,
            Some(2e3 * scene.scenario.controller.period.seconds()),
            scene.drive_limited_ms(),
            scene.is_noisy().then(|| scene.noise_floor_percent()),
        ];
        let _ = writeln!(
            text,
            "{},{},{},{},{},{}",
            row.law.name(),
            quote_csv_field(&scene.name),
            quote_csv_field(&scene.scenario.file),
            scene.trials,
            row.settled_trials,
            cells.map(number).join(",")
        );
    }
    text
}

fn scatter_chart(scenes: &[LawScenario], found: &[LawResult]) -> ScatterChart {
    let laws: Vec<LawId> = LawId::ALL.into();
    let panel = |is_noisy: bool, y_label: &str, y: &dyn Fn(&LawResult) -> Option<f64>| {
        let own: Vec<(usize, &LawScenario)> =
            scenes.iter().enumerate().filter(|(_, scene)| scene.is_noisy() == is_noisy).collect();
        let point = |found: &LawResult| {
            Some(ScatterPoint {
                colour: laws.iter().position(|law| *law == found.law)?,
                shape: own.iter().position(|(number, _)| *number == found.scenario_index)?,
                x: found.response_ms,
                y: y(found)?,
            })
        };
        let floors = own.iter().filter(|_| is_noisy);
        ScatterPanel {
            y_label: y_label.to_owned(),
            floor: SCALE_FLOOR,
            shapes: own.iter().map(|(_, scene)| scene.name.clone()).collect(),
            points: found.iter().filter_map(point).collect(),
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
        colours: laws.iter().map(|law| law.name().to_owned()).collect(),
        edge_label: "never within 5 %".to_owned(),
        panels: vec![
            panel(false, "static error, %", &|found| found.static_error_percent),
            panel(true, "repeatability over trials, %", &|found| found.repeatability_percent),
        ],
    }
}

/// Two periods, and the floors of the drive; alike ones once.
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
