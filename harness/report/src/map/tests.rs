use super::*;
use rstest::rstest;

fn map() -> Map {
    let panel = Panel {
        title: "resonant, 2 ms & more".to_owned(),
        periods_ms: vec![0.5, 1.0, 1.5],
        delays_ms: vec![0.0, 1.0, 2.0, 3.0],
        radius: vec![vec![0.2, 0.9, 1.1, 1.6], vec![0.2, 0.2, 0.8, 1.2], vec![0.4, 0.4, 0.4, 0.4]],
        measured: vec![(0.5, 1.5), (1.0, 2.5), (1.0, 99.0)],
    };
    Map {
        title: "a < b".to_owned(),
        panels: vec![panel.clone(), panel],
        columns: 2,
        rig: Some(RigDelay { typical_ms: 0.5, longest_ms: 0.9 }),
    }
}

#[test]
fn a_drawing_is_xml_with_classes_and_no_colours_of_its_own() {
    let svg = map().svg().unwrap();
    let body = svg.split_once("</style>").unwrap().1;
    assert!(!body.contains('#'), "{body}");
    for class in ["f-r0", "f-r5", "f-r9", "s-boundary", "s-rig", "f-point", "f-title"] {
        assert!(body.contains(class), "{class}");
    }
    let mut reader = quick_xml::Reader::from_str(&svg);
    loop {
        match reader.read_event().unwrap() {
            quick_xml::events::Event::Eof => break,
            quick_xml::events::Event::Text(text) => drop(text.decode().unwrap()),
            _ => {}
        }
    }
    // Two panels with two points each; what lies outside is not drawn.
    assert_eq!(body.matches("<circle").count(), 4);
    // A typical and a longest delay in each panel.
    assert_eq!(body.matches("s-rig").count(), 4);
}

#[test]
fn the_boundary_lies_between_rows_and_stops_where_there_is_none() {
    let panel = &map().panels[0];
    let [line] = &panel.boundary()[..] else { panic!("{:?}", panel.boundary()) };
    let [first, second] = line[..] else { panic!("{line:?}") };
    assert!((first.0 - 0.5).abs() < 1e-12 && (first.1 - 1.5).abs() < 1e-12, "{first:?}");
    assert!((second.0 - 1.0).abs() < 1e-12 && (second.1 - 2.5).abs() < 1e-12, "{second:?}");
}

#[rstest]
#[case(0.0, 0)]
#[case(0.2999, 0)]
#[case(0.3, 1)]
#[case(0.9999, 5)]
#[case(1.0, 6)]
#[case(1.5, 9)]
#[case(f64::INFINITY, 9)]
#[case(f64::NAN, 9)]
fn a_class_ends_before_its_edge(#[case] radius: f64, #[case] expected: u8) {
    assert_eq!(class(radius), expected);
}

#[test]
fn neighbours_of_one_class_are_one_rectangle() {
    assert_eq!(runs(&[0.1, 0.2, 0.9, 0.1]), [(0, 0, 1), (5, 2, 2), (0, 3, 3)]);
    assert!(runs(&[]).is_empty());
}

#[test]
fn a_panel_without_numbers_draws_nothing_and_nothing_breaks() {
    let mut empty = map();
    empty.panels[0] = Panel { periods_ms: vec![1.0], ..empty.panels[0].clone() };
    empty.panels[1] = Panel { radius: Vec::new(), measured: Vec::new(), ..empty.panels[1].clone() };
    assert!(!empty.svg().unwrap().contains("<circle"));
}

#[test]
fn a_page_needs_nothing_else() {
    let section =
        Section { title: "Maps".to_owned(), note: String::new(), table: Some("law  <1>".to_owned()), map: Some(map()) };
    let page = page("Stability", &[section]).unwrap();
    assert!(page.contains("law  &lt;1&gt;") && page.contains("class=\"map\""));
    for elsewhere in ["<script", "<link", "src=", "url("] {
        assert!(!page.contains(elsewhere), "{elsewhere}");
    }
}
