//! Draws the response time of laws against static error and repeatability, with absolute limits.

use crate::error::ChartError;
use crate::law_results::{LawResult, LawScenario};
use crate::law_variants;
use platebench_plate::Time;
use platebench_report::chart::{ScatterChart, ScatterPanel, ScatterPoint};
use platebench_report::document::{Block, Document, Table};
use platebench_report::page::ChartSection;
use platebench_wire::LawId;

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
    let variants = law_variants::measure(&quiet)?;
    let multiples = law_variants::svg(&quiet, &variants);
    let files = [(FILE, csv_table(scenes, &results).csv()), (TABLE, table.markdown()), (DRAWING, svg.clone())];
    let variant_files =
        [(law_variants::CSV, law_variants::csv(&quiet, &variants)), (law_variants::DRAWING, multiples.clone())];
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into())];
    let caption = "Control laws: response time, static error, repeatability".to_owned();
    blocks.push(Block::figure(svg, caption));
    blocks.push(Block::Details(vec![Block::paragraph(VARIANTS_EXPLANATION)]));
    let caption = "Control laws: response time at loop delays of 0, 0.4 and 0.8 periods".to_owned();
    blocks.push(Block::figure(multiples, caption));
    blocks.push(Block::Table(table));
    blocks.extend([FILE, TABLE, law_variants::CSV].map(|name| Block::File(name.to_owned())));
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
    let laws: Vec<LawId> = LawId::ALL.into();
    let panel = |is_noisy: bool, y_label: &str, y: &dyn Fn(&LawResult) -> Option<f64>| {
        let own: Vec<(usize, &LawScenario)> =
            scenes.iter().enumerate().filter(|(_, scene)| scene.is_noisy() == is_noisy).collect();
        let point = |result: &LawResult| {
            Some(ScatterPoint {
                colour: laws.iter().position(|law| *law == result.law)?,
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
        colours: laws.iter().map(|law| law.name().to_owned()).collect(),
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
