//! Finds plates that no ultrasonic tactile plate resembles, and a finger that the plate ignores.

use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::Diagnostic;

/// Warns of implausible values of the plate, and of a force that changes nothing.
pub fn plate_warnings(scenario: &Scenario) -> Vec<Diagnostic> {
    let at = |key: &'static str| move |value: platebench_plate::ImplausibleValue| (key, value);
    let design = scenario.controller.design_plate.iter().flat_map(platebench_plate::Plate::implausible_values);
    let plates = scenario.plate.implausible_values().into_iter().map(at("plate"));
    let plates = plates.chain(design.map(at("controller.design_plate")));
    let mut warnings: Vec<Diagnostic> = plates
        .map(|(key, value)| scenario.diagnostic(key, format!("`{}` of the plate file: {value}", value.range.key)))
        .collect();
    if scenario.conditions.finger_force_n.range().1 > 0.0 && !scenario.plate.depends_on_force() {
        let message = "the plate file has no [finger], so this force changes nothing";
        warnings.push(scenario.diagnostic("profile.finger_force_n", message));
    }
    warnings
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warns_of_an_impossible_gain_and_an_ignored_force() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios");
        let paper = std::fs::read_to_string(root.join("plates/aluminium-198x138.toml")).unwrap();
        let scenario = "title = \"a\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
                        finger_force_n = 1.0\n[[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n";
        let messages = |plate: &str| -> Vec<String> {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join("plate.toml"), plate).unwrap();
            let path = folder.path().join("s.toml");
            std::fs::write(&path, scenario).unwrap();
            plate_warnings(&crate::scenario::load(&path, "s.toml").unwrap())
                .into_iter()
                .map(|warning| warning.message)
                .collect()
        };
        assert_eq!(messages(&paper), Vec::<String>::new());
        let nm = paper.replacen("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 6.98", 1);
        assert!(messages(&nm)[0].starts_with("`mode.gain_um_per_vpp` of the plate file: gain K1 of 6.98 µm/Vpp"));
        let start = paper.find("[finger]").unwrap();
        let end = start + paper[start..].find("[drive]").unwrap();
        let without = format!("{}{}", &paper[..start], &paper[end..]);
        let ignored = "`finger_force_n`: the plate file has no [finger], so this force changes nothing";
        assert_eq!(messages(&without), [ignored]);
    }
}
