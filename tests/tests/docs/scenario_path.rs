//! Checks that the path of a scenario in `docs/architecture.md` consists of calls that exist.

use platebench_test_kit::workspace_root;
use std::fs;

const MAX_CALLS: usize = 20;

#[derive(Debug)]
struct Call {
    function: String,
    file: String,
    /// Number of the call in whose file this one is; `None` for the first.
    caller: Option<usize>,
}

/// Rows of the table below the heading; their numbers are 1, 2, 3 and so on.
fn calls(page: &str) -> Vec<Call> {
    let section = page.split("## The path of one scenario\n").nth(1).unwrap().split("\n## ").next().unwrap();
    let rows = section.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| call"));
    let call = |(index, line): (usize, &str)| {
        let cells: Vec<_> = line.split('|').map(|cell| cell.trim().trim_matches('`').to_owned()).collect();
        let [_, number, function, file, caller, ..] = cells.as_slice() else { panic!("{line}") };
        assert_eq!(*number, (index + 1).to_string(), "{line}");
        Call { function: function.clone(), file: file.clone(), caller: caller.parse().ok() }
    };
    rows.enumerate().map(call).collect()
}

/// What is wrong with each call: no such function, or no call of it in the file of its caller.
fn problems(calls: &[Call]) -> Vec<String> {
    let source = |file: &str| fs::read_to_string(workspace_root().join(file)).unwrap_or_default();
    let problem = |call: &Call| {
        let Call { function, file, caller } = call;
        let (definition, use_of) = (format!("fn {function}"), format!("{function}("));
        if !source(file)
            .lines()
            .any(|line| line.contains(&format!("{definition}(")) || line.contains(&format!("{definition}<")))
        {
            return Some(format!("{file} has no `{definition}`"));
        }
        let caller = &calls.get((*caller)?.checked_sub(1)?)?.file;
        let is_called = source(caller).lines().any(|line| line.contains(&use_of) && !line.contains(&definition));
        (!is_called).then(|| format!("{caller} does not call `{function}`"))
    };
    calls.iter().filter_map(problem).collect()
}

#[test]
fn the_path_of_a_scenario_consists_of_real_calls() {
    let page = fs::read_to_string(workspace_root().join("docs/architecture.md")).unwrap();
    let mut calls = calls(&page);
    assert!((10..=MAX_CALLS).contains(&calls.len()), "{} calls", calls.len());
    assert!(calls.iter().skip(1).all(|call| call.caller.is_some()), "{calls:?}");
    assert_eq!(problems(&calls), Vec::<String>::new());
    calls[11].function = "play_backwards".to_owned();
    calls[14].caller = Some(2);
    assert_eq!(
        problems(&calls),
        [
            "harness/engine/src/lockstep.rs has no `fn play_backwards`",
            "harness/cli/src/run.rs does not call `measure_trial`"
        ]
    );
}
