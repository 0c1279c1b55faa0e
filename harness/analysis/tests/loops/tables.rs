//! The study as a table and as CSV.

use crate::plate;
use platebench_analysis::study::Order;
use platebench_analysis::{Study, shown, study};
use platebench_wire::LawId;

fn of(laws: &[LawId], delay: f64, jobs: usize) -> Study {
    study(&Order { plate: plate(), laws: laws.to_vec(), delay, maps: false, jobs }).unwrap()
}

#[test]
fn margins_shrink_by_the_rig_s_delay_and_the_boundary_does_not() {
    let [without, with] = [0.0, 0.5e-3].map(|delay| of(&[LawId::DqPiEuler], delay, 1));
    for (without, with) in without.rows.iter().zip(&with.rows) {
        assert_eq!(with.predicted, without.predicted);
        let left = without.delay_margin.unwrap() - with.delay_margin.unwrap();
        assert!((left - 0.5e-3).abs() < 1e-12, "{left}");
        assert!(with.phase_margin_deg < without.phase_margin_deg, "{with:?}");
        assert!(with.difference_percent().unwrap().abs() < 2.0, "{with:?}");
    }
}

#[test]
fn the_study_is_the_same_whoever_does_it() {
    let laws = [LawId::OpenLoop, LawId::Pll];
    let one = of(&laws, 0.0, 1);
    assert_eq!(one, of(&laws, 0.0, 3));
    let csv = shown::boundaries_csv(&one);
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines.len(), 7);
    assert!(lines.iter().all(|line| line.split(',').count() == 12), "{csv}");
    // No loop: no boundary as far as was looked, and no margin.
    assert!(lines[1].starts_with("open-loop,resonant,1000,1.9,inf,inf,,inf,0.58"), "{csv}");
    assert!(lines[1].ends_with(",,,"), "{csv}");
    let table = shown::table(&one, 0.0);
    assert!(table.contains("> 12000") && table.contains("never"), "{table}");
}

#[test]
fn what_is_out_of_reach_is_said_to_be() {
    let mut plate = plate();
    plate.drive_limit_vpp = 100.0;
    let order = Order { plate, laws: vec![LawId::FrequencyOnly], delay: 0.0, maps: true, jobs: 2 };
    let study = study(&order).unwrap();
    assert!(study.rows.is_empty() && study.maps.is_empty());
    assert_eq!(study.out_of_reach.len(), 3);
    assert!(shown::table(&study, 0.0).contains("frequency-only  finger     no steady state within the drive's limit"));
}
