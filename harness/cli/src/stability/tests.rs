use super::*;
use platebench_design::step_limits::{StepLimit, step_limits};

fn arguments(out: Option<&Path>) -> StabilityArgs {
    StabilityArgs {
        out: out.map(Path::to_owned),
        laws: vec!["open-loop".to_owned()],
        plate: Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/plates/aluminium-198x138.toml"),
        measured_delay_us: None,
        run: None,
        jobs: Some(1),
    }
}

#[test]
fn the_largest_steps_of_methods_are_next_to_theory() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    let text = analyse(&arguments(Some(&out))).unwrap();
    let row = |method: &str, problem: &str| {
        let found = text.lines().find(|line| line.starts_with(method) && line.contains(problem));
        let found = found.unwrap_or_else(|| panic!("{method}, {problem}: {text}"));
        found.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let euler = row("explicit Euler", "envelope, 545 rad/s off");
    assert!(euler.contains("1.834 ms 1.834 ms 0.00 %"), "{euler}");
    assert!(
        row("RK4", "modal").contains("6.974 µs 6.967 µs 0.10 %") && row("RK4", "modal").contains("h·2ω0 = 2.831"),
        "{text}"
    );
    assert!(row("Störmer-Verlet", "carrier").contains("3.142 points per period"), "{text}");
    assert!(row("exact", "modal").contains("no limit no limit"), "{text}");
    assert!(text.find("Methods").unwrap() < text.find("Loops").unwrap(), "{text}");
    let rows = step_limits(&load_plate(&arguments(None).plate).unwrap());
    let csv = fs::read_to_string(out.join("methods.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + rows.len());
    for row in &rows {
        assert!(row.deviation().is_none_or(|share| share.abs() < 0.02), "{row:?}");
        assert_eq!(matches!(row.measured, StepLimit::Step(_)), matches!(row.predicted, StepLimit::Step(_)), "{row:?}");
        assert!(csv.contains(row.problem), "{row:?}");
    }
    let page = fs::read_to_string(out.join("stability.html")).unwrap();
    assert!(page.find("the largest stable step").unwrap() < page.find("longest stable loop delay").unwrap());
    assert!(page.contains("3.142 points per period"), "{}", page.len());
}
