//! Tests the study as a table and as CSV.

use platebench_design::stability::{Study, StudyConfig, boundaries_csv, boundary_table, study};
use platebench_test_kit::paper_plate;
use platebench_wire::LawId;

fn study_of(laws: &[LawId], delay: f64, jobs: usize) -> Study {
    study(&StudyConfig { plate: paper_plate(), laws: laws.to_vec(), delay, maps: false, jobs }).unwrap()
}

#[test]
fn the_rig_delay_reduces_margins_but_not_the_boundary() {
    let [without, with] = [0.0, 0.5e-3].map(|delay| study_of(&[LawId::DqPiEuler], delay, 1));
    for (without, with) in without.rows.iter().zip(&with.rows) {
        assert_eq!(with.predicted, without.predicted);
        let left = without.margins.delay_ms.unwrap() - with.margins.delay_ms.unwrap();
        assert!((left - 0.5).abs() < 1e-9, "{left}");
        assert!(with.margins.phase_deg < without.margins.phase_deg, "{with:?}");
        assert!(with.difference_percent().unwrap().abs() < 2.0, "{with:?}");
    }
}

#[test]
fn the_number_of_jobs_does_not_change_the_study() {
    let laws = [LawId::OpenLoop, LawId::Pll];
    let one = study_of(&laws, 0.0, 1);
    assert_eq!(one, study_of(&laws, 0.0, 3));
    let csv = boundaries_csv(&one);
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines.len(), 7);
    assert!(lines.iter().all(|line| line.split(',').count() == 12), "{csv}");
    // Without a loop, the boundary is beyond the search range (`inf`) and margins are empty.
    assert!(lines[1].starts_with("open-loop,resonant,1000,1.9,inf,inf,,inf,0.58"), "{csv}");
    assert!(lines[1].ends_with(",,,"), "{csv}");
    let table = boundary_table(&one).lines().join("\n");
    assert!(table.contains("> 12000") && table.contains("never"), "{table}");
}

#[test]
fn the_table_lists_conditions_out_of_reach() {
    let mut plate = paper_plate();
    plate.drive_limit_vpp = 100.0;
    let order = StudyConfig { plate, laws: vec![LawId::FrequencyOnly], delay: 0.0, maps: true, jobs: 2 };
    let study = study(&order).unwrap();
    assert!(study.rows.is_empty() && study.maps.is_empty());
    assert_eq!(study.out_of_reach.len(), 3);
    let table = boundary_table(&study).lines().join("\n");
    assert!(table.contains("frequency-only  finger     no steady state within the drive's limit"), "{table}");
}
