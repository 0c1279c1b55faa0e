use super::*;
use rstest::rstest;

fn map() -> MapFigure {
    let panel = MapPanel {
        title: "resonant, 2 ms & more".to_owned(),
        periods_ms: vec![0.5, 1.0, 1.5],
        delays_ms: vec![0.0, 1.0, 2.0, 3.0],
        radius: vec![vec![0.2, 0.9, 1.1, 1.6], vec![0.2, 0.2, 0.8, 1.2], vec![0.4, 0.4, 0.4, 0.4]],
        settling_ms: vec![
            vec![Some(1.0), Some(12.0), None, None],
            vec![Some(1.0), Some(1.0), Some(5.0), None],
            vec![Some(2.5); 4],
        ],
        measured: vec![(0.5, 1.5), (1.0, 2.5), (1.0, 99.0)],
    };
    MapFigure {
        title: "a < b".to_owned(),
        panels: vec![panel.clone(), panel],
        columns: 2,
        rig: Some(RigDelay { typical_ms: 0.5, longest_ms: 0.9 }),
    }
}

#[test]
fn draws_classes_boundaries_delays_and_legend() {
    insta::assert_snapshot!(map().svg().unwrap().replace("><", ">\n<"));
}

#[test]
fn interpolates_the_boundary_between_rows() {
    let panel = &map().panels[0];
    let [line] = &panel.stability_boundary()[..] else { panic!("{:?}", panel.stability_boundary()) };
    let [first, second] = line[..] else { panic!("{line:?}") };
    assert!((first.0 - 0.5).abs() < 1e-12 && (first.1 - 1.5).abs() < 1e-12, "{first:?}");
    assert!((second.0 - 1.0).abs() < 1e-12 && (second.1 - 2.5).abs() < 1e-12, "{second:?}");
}

#[rstest]
#[case(Some(0.0), 0)]
#[case(Some(1.4999), 0)]
#[case(Some(1.5), 1)]
#[case(Some(9.999), 5)]
#[case(Some(10.0), 6)]
#[case(Some(40.0), 9)]
#[case(None, 9)]
fn a_class_ends_below_its_edge(#[case] settling_ms: Option<f64>, #[case] expected: usize) {
    assert_eq!(settling_class(settling_ms), expected);
}

#[test]
fn joins_rows_of_one_class() {
    assert_eq!(class_runs(&[Some(0.1), Some(0.2), Some(9.0), None]), [(0, 0, 1), (5, 2, 2), (9, 3, 3)]);
    assert!(class_runs(&[]).is_empty());
}

#[test]
fn skips_a_panel_without_numbers() {
    let mut empty = map();
    empty.panels[0] = MapPanel { periods_ms: vec![1.0], ..empty.panels[0].clone() };
    empty.panels[1] = MapPanel { settling_ms: Vec::new(), measured: Vec::new(), ..empty.panels[1].clone() };
    assert_eq!(empty.svg().unwrap().matches("<circle").count(), 1);
}
