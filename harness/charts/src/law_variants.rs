//! Plays every law with known and unknown loop delays and with other plate gains, and draws charts.

use crate::error::ChartError;
use crate::law_results::LawScenario;
use crate::measured_run::play_hosted;
use platebench_model::scenario::Scenario;
use platebench_plate::Time;
use platebench_report::chart::{MultiplesChart, MultiplesPoint};
use platebench_report::document::Table;
use platebench_wire::LawId;

pub(crate) const CSV: &str = "law-variants.csv";
pub(crate) const DRAWING: &str = "law-variants.svg";
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

pub(crate) struct VariantResult {
    law: LawId,
    /// Indices into the scenes, [`VARIANTS`] and [`DELAYS`].
    at: [usize; 3],
    /// `None` if |W| does not stay in the band.
    response_ms: Option<f64>,
    overshoot_percent: f64,
}

/// Plays one trial of each variant, so the scenes must not have noise.
pub(crate) fn measure(scenes: &[&LawScenario]) -> Result<Vec<VariantResult>, ChartError> {
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

pub(crate) fn csv(scenes: &[&LawScenario], results: &[VariantResult]) -> String {
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

pub(crate) fn svg(scenes: &[&LawScenario], results: &[VariantResult]) -> String {
    let laws = LawId::ALL;
    let panel = |scene: usize, variant: usize| {
        let own = results.iter().filter(move |result| result.at[..2] == [scene, variant]);
        let points = own.filter_map(|result| {
            Some(MultiplesPoint {
                series: laws.iter().position(|law| *law == result.law)?,
                setting: result.at[2],
                value: result.response_ms,
                is_hollow: result.overshoot_percent > LARGE_OVERSHOOT_PERCENT,
            })
        });
        points.collect()
    };
    MultiplesChart {
        title: "Control laws: loop delay, and plates that the law does not expect".to_owned(),
        value_label: "response time to 5 %, ms".to_owned(),
        setting_label: "loop delay in control periods".to_owned(),
        settings: DELAYS.map(|delay| delay.to_string()).into(),
        series: laws.iter().map(|law| law.name().to_owned()).collect(),
        rows: scenes.iter().map(|scene| scene.name.clone()).collect(),
        columns: VARIANTS.iter().map(|variant| variant.name.to_owned()).collect(),
        edge_label: "never within 5 %".to_owned(),
        hollow_label: format!("hollow: overshoot above {LARGE_OVERSHOOT_PERCENT} %"),
        panels: (0..scenes.len()).map(|scene| (0..VARIANTS.len()).map(|at| panel(scene, at)).collect()).collect(),
    }
    .svg()
}
