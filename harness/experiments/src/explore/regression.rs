//! Writes a minimal scene as a scenario that the next run and the next exploration play.

use crate::explore::error::ExploreError;
use crate::explore::exploration::{ExploreConfig, FailedScene};
use crate::explore::properties::Property;
use crate::explore::scenario_file::ScenarioBuilder;
use crate::explore::shrink::MinimalScene;
use platebench_model::trace::AtPath;
use std::fs;
use std::path::{Path, PathBuf};

/// Returns the path of the scenario. `rig` is the rig as named on the command line.
pub fn write(
    folder: &Path,
    config: &ExploreConfig,
    rig: &str,
    failed: &FailedScene,
    minimal: &MinimalScene,
) -> Result<PathBuf, ExploreError> {
    let property = minimal.failure.property;
    let (law, seed, index) = (config.law.name(), config.seed, failed.index);
    let name = format!("{law}-{property}-{seed}-{index}");
    let title = format!("Explored: {law} violates the property {property} (scene {index} of seed {seed})");
    let builder = ScenarioBuilder {
        base: &config.envelope.plate,
        title: &title,
        source: "platebench suite explore; the property and its limit: docs/exploration.md",
        plate_prefix: &format!("{name}-"),
    };
    fs::create_dir_all(folder).at(folder)?;
    let scenario = builder.build(&minimal.scene, &minimal.demands);
    scenario.write(folder, &name, &comment(rig, law, minimal)).at(folder)?;
    Ok(folder.join(format!("{name}.toml")))
}

fn comment(rig: &str, law: &str, minimal: &MinimalScene) -> Vec<String> {
    let failure = &minimal.failure;
    let number = |value: Option<f64>| value.map_or_else(|| "none".to_owned(), |value| format!("{value:.6}"));
    let unit = failure.property.metric().map_or("", |metric| metric.name());
    let measured = if failure.property == Property::Protocol {
        failure.name.clone()
    } else {
        format!("measured {} {unit}, limit {}", number(failure.value), number(failure.limit))
    };
    let mut lines = vec![
        format!("Written by platebench suite explore: a minimal scene that violates a property."),
        format!("property: {}", failure.property),
        format!("value: {measured}"),
        format!("law: {law}"),
        format!("rig: {rig}").replace(char::is_control, " "),
    ];
    if !minimal.is_reproduced {
        lines.push("The scene did not fail again with a new controller, so it is not minimal.".to_owned());
    }
    lines
}
