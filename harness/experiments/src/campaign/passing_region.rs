//! Finds the largest value of a listed number that passes with all smaller ones, and the islands of
//! the passing region.
//!
//! The number is the loop delay if it is listed, otherwise the design delay, otherwise the listed
//! number that varies fastest. An island is a passing part that a failing cell separates from the
//! others: along the number, or in the plane of the number and a second one (4-neighbours).

use crate::campaign::distribution::{Choice, Variable};
use crate::campaign::results::axis_label;
use crate::campaign::summary::Summary;
use platebench_document::{Block, Column, Table};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

const DELAY_KEYS: [&str; 2] = ["controller.loop_delay_ms", "controller.design_delay_ms"];
/// Largest number of combinations, and of lines about islands, on the console.
const MAX_CONSOLE_ROWS: usize = 20;

/// `passing_region` in `summary.json`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct PassingRegion {
    /// Key of the number.
    pub axis: String,
    /// One per combination of the other listed values.
    pub ranges: Vec<PassingRange>,
    /// Key of the second number of the planes.
    pub second_axis: Option<String>,
    /// One per combination of the listed values other than both numbers. Empty without a second
    /// number.
    pub planes: Vec<PassingPlane>,
    #[serde(skip)]
    header: Vec<Column>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct PassingRange {
    pub values: Value,
    /// `None` if the smallest value does not pass.
    pub largest: Option<f64>,
    /// True if all values pass, so that the largest passing value may be outside the list.
    pub is_whole_list: bool,
    /// Passing values above the first that does not pass.
    pub passes_again_at: Vec<f64>,
    #[serde(skip)]
    texts: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct PassingPlane {
    pub values: Value,
    /// Number of connected parts of the passing cells.
    pub regions: usize,
    #[serde(skip)]
    text: String,
}

/// A listed value of a cell.
type CellChoice<'a> = (&'a Variable, usize);

/// Listed values and cells by the indices of the values, in the order of the campaign's cells.
type Combinations<'a, C> = BTreeMap<Vec<usize>, (Vec<CellChoice<'a>>, Vec<C>)>;

impl PassingRegion {
    /// `None` without a listed number that has two values.
    pub(crate) fn new(summary: &Summary<'_>) -> Option<Self> {
        let numbers: Vec<&Variable> = summary.campaign.variables.iter().filter(|variable| is_axis(variable)).collect();
        let delay = DELAY_KEYS.iter().find_map(|key| numbers.iter().find(|variable| variable.key == *key));
        let axis: &Variable = delay.or(numbers.last())?;
        let second = numbers.iter().rev().find(|variable| variable.key != axis.key).copied();
        // True for a cell that passes; positions of passing cells.
        let mut ranges: Combinations<'_, (f64, bool)> = BTreeMap::new();
        let mut planes: Combinations<'_, [usize; 2]> = BTreeMap::new();
        if summary.cells.is_empty() {
            return None;
        }
        for (number, cell) in summary.cells.iter().enumerate().filter(|(_, cell)| !cell.is_not_applicable()) {
            let choices = summary.campaign.cell_choices(number);
            let passes = cell.passes(summary.campaign.at_most) == Some(true);
            let other = |axes: &[&str]| -> Vec<CellChoice<'_>> {
                choices.iter().filter(|(variable, _)| !axes.contains(&&*variable.key)).copied().collect()
            };
            let place = |axis: &Variable| {
                choices.iter().find(|(variable, _)| variable.key == axis.key).map_or(0, |(_, choice)| *choice)
            };
            let indices = |choices: &[CellChoice<'_>]| choices.iter().map(|(_, choice)| *choice).collect::<Vec<_>>();
            let own = other(&[&axis.key]);
            let value = axis.distribution.number(place(axis) as f64).unwrap_or(f64::NAN);
            ranges.entry(indices(&own)).or_insert_with(|| (own, Vec::new())).1.push((value, passes));
            if let Some(second) = second {
                let own = other(&[&axis.key, &second.key]);
                let (_, cells) = planes.entry(indices(&own)).or_insert_with(|| (own, Vec::new()));
                if passes {
                    cells.push([rank(axis, place(axis)), rank(second, place(second))]);
                }
            }
        }
        let others = summary.campaign.variables.iter().filter(|variable| variable.distribution.choices().is_some());
        let others = others.filter(|variable| variable.key != axis.key);
        let label = axis_label(axis);
        let columns = [format!("largest {label}"), "passes again at".to_owned()].map(|name| Column::number(&name, ""));
        Some(Self {
            axis: axis.key.clone(),
            ranges: ranges.into_values().map(|(choices, cells)| PassingRange::new(&choices, cells)).collect(),
            second_axis: second.map(|second| second.key.clone()),
            planes: planes.into_values().map(|(choices, cells)| PassingPlane::new(&choices, cells)).collect(),
            header: others.map(|variable| Column::from(axis_label(variable))).chain(columns).collect(),
        })
    }

    /// Blocks for console and page, and the rows that only the page has.
    pub(crate) fn blocks(&self) -> (Vec<Block>, Option<Block>) {
        let (first, further) = self.ranges.split_at(self.ranges.len().min(MAX_CONSOLE_ROWS));
        let mut blocks = vec![
            Block::heading(format!("Largest {} that passes with all smaller ones", self.axis)),
            Block::Table(self.table(first)),
        ];
        if !further.is_empty() {
            let text = format!("{} further combinations are in the report and in summary.json.", further.len());
            blocks.push(Block::Paragraph(text));
        }
        blocks.push(Block::lines(self.island_lines()));
        (blocks, (!further.is_empty()).then(|| Block::Table(self.table(further))))
    }

    fn table(&self, ranges: &[PassingRange]) -> Table {
        let mut table = Table::new(self.header.clone());
        table.extend(ranges.iter().map(|range| range.texts.iter().cloned().chain(range.result_texts())));
        table
    }

    fn island_lines(&self) -> Vec<String> {
        let again = self.ranges.iter().filter(|range| !range.passes_again_at.is_empty()).count();
        let Some(second) = &self.second_axis else {
            let text = if again == 0 { "no islands" } else { "islands" };
            return vec![format!(
                "{text}: {again} of {} combinations pass again above a failing value",
                self.ranges.len()
            )];
        };
        let islands: Vec<_> = self.planes.iter().filter(|plane| plane.regions > 1).collect();
        let text = if islands.is_empty() { "no islands" } else { "islands" };
        let mut lines = vec![format!(
            "{text}: {} of {} maps of {} and {second} have separate passing regions; {again} of {} combinations pass \
             again above a failing value",
            islands.len(),
            self.planes.len(),
            self.axis,
            self.ranges.len()
        )];
        let line = |plane: &&PassingPlane| format!("  {} regions: {}", plane.regions, plane.text);
        lines.extend(islands.iter().filter(|plane| !plane.text.is_empty()).take(MAX_CONSOLE_ROWS).map(line));
        lines
    }
}

impl PassingRange {
    fn new(choices: &[CellChoice<'_>], mut cells: Vec<(f64, bool)>) -> Self {
        cells.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        let first_miss = cells.iter().position(|(_, passes)| !passes).unwrap_or(cells.len());
        let (below, above) = cells.split_at(first_miss);
        Self {
            values: values(choices),
            largest: below.last().map(|(value, _)| *value),
            is_whole_list: above.is_empty(),
            passes_again_at: above.iter().filter(|(_, passes)| *passes).map(|(value, _)| *value).collect(),
            texts: choices.iter().map(|(variable, choice)| variable.text(*choice as f64)).collect(),
        }
    }

    fn result_texts(&self) -> [String; 2] {
        let largest = match self.largest {
            Some(value) if self.is_whole_list => format!("≥ {value}"),
            Some(value) => value.to_string(),
            None => "none".to_owned(),
        };
        let again = self.passes_again_at.iter().map(ToString::to_string).collect::<Vec<_>>();
        [largest, again.join(" ")]
    }
}

impl PassingPlane {
    /// `cells` are the positions of the passing cells.
    fn new(choices: &[CellChoice<'_>], cells: Vec<[usize; 2]>) -> Self {
        let texts = choices
            .iter()
            .map(|(variable, choice)| format!("{} {}", variable.short_name(), variable.text(*choice as f64)));
        Self { values: values(choices), regions: count_regions(cells), text: texts.collect::<Vec<_>>().join(", ") }
    }
}

fn is_axis(variable: &Variable) -> bool {
    variable.is_number() && variable.distribution.choices().is_some_and(|list| list.len() > 1)
}

fn values(choices: &[CellChoice<'_>]) -> Value {
    let pairs = choices
        .iter()
        .map(|(variable, choice)| (variable.key.clone(), json!(variable.distribution.value(*choice as f64))));
    Value::Object(pairs.collect::<Map<_, _>>())
}

/// Number of listed values below that of `choice`, because a list need not be sorted.
fn rank(variable: &Variable, choice: usize) -> usize {
    let list = variable.distribution.choices().unwrap_or_default();
    let value = |index: usize| list.get(index).and_then(Choice::number).unwrap_or(f64::NAN);
    (0..list.len()).filter(|other| value(*other) < value(choice)).count()
}

fn count_regions(cells: Vec<[usize; 2]>) -> usize {
    let mut left: std::collections::BTreeSet<[usize; 2]> = cells.into_iter().collect();
    let mut regions = 0;
    while let Some(first) = left.pop_first() {
        regions += 1;
        let mut open = vec![first];
        while let Some([x, y]) = open.pop() {
            let neighbours = [[x + 1, y], [x, y + 1], [x.wrapping_sub(1), y], [x, y.wrapping_sub(1)]];
            open.extend(neighbours.into_iter().filter(|neighbour| left.remove(neighbour)));
        }
    }
    regions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::definition::Campaign;
    use crate::campaign::row::TrialRow;
    use platebench_model::record::Verdict;
    use rstest::rstest;

    fn range(cells: &[(f64, bool)]) -> (Option<f64>, bool, Vec<f64>) {
        let PassingRange { largest, is_whole_list, passes_again_at, .. } = PassingRange::new(&[], cells.to_vec());
        (largest, is_whole_list, passes_again_at)
    }

    #[test]
    fn the_largest_value_has_only_passing_values_below() {
        let sorted = [(0.0, true), (0.1, true), (0.2, false), (0.3, true), (0.4, false)];
        let expected = (Some(0.1), false, vec![0.3]);
        assert_eq!(range(&sorted), expected);
        assert_eq!(range(&sorted.into_iter().rev().collect::<Vec<_>>()), expected);
        assert_eq!(range(&[(0.0, true), (1.0, true)]), (Some(1.0), true, Vec::new()));
        assert_eq!(range(&[(0.0, false), (1.0, true)]), (None, false, vec![1.0]));
        assert_eq!(range(&[(0.0, false)]), (None, false, Vec::new()));
    }

    #[rstest]
    #[case(&[], 0)]
    #[case(&[[0, 0], [0, 1], [1, 1]], 1)]
    #[case(&[[0, 0], [1, 1]], 2)]
    #[case(&[[0, 0], [0, 1], [0, 2], [1, 0], [2, 0], [2, 1], [2, 2]], 1)]
    #[case(&[[0, 0], [0, 2], [2, 0], [2, 2], [1, 1]], 5)]
    fn diagonal_cells_are_not_connected(#[case] cells: &[[usize; 2]], #[case] expected: usize) {
        assert_eq!(count_regions(cells.to_vec()), expected);
    }

    fn region(vary: &str, fails: impl Fn(&[f64]) -> bool) -> Option<PassingRegion> {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), vary, "[plan]\nmethod = \"grid\"\ntrials = 1\n");
        let mut summary = Summary::new(&campaign);
        for number in 0..campaign.trials {
            let draws = campaign.trial(number).unwrap().values;
            let verdict = if fails(&draws) { Verdict::Fail } else { Verdict::Pass };
            summary.add(&TrialRow { draws, values: vec![1.0], ..TrialRow::example(number, verdict, 0.5) });
        }
        PassingRegion::new(&summary)
    }

    /// The values of a list are not sorted, and the delay does not vary fastest.
    #[test]
    fn the_axis_is_the_delay_in_ascending_order() {
        let vary = "\"controller.law\" = { each = [\"dq-pi\", \"deadbeat\"] }\n\
            \"controller.loop_delay_ms\" = { each = [0.2, 0.0, 0.1] }\n\
            \"profile.finger_force_n\" = { steps = [0.0, 2.0, 3] }\n";
        // `deadbeat` fails at 0.1 ms under 1 N, the middle of its plane, and at 0.1 ms under 0 N.
        let region = region(vary, |draws| draws[0] == 1.0 && draws[1] == 2.0 && draws[2] < 2.0).unwrap();
        assert_eq!(
            (&*region.axis, region.second_axis.as_deref()),
            ("controller.loop_delay_ms", Some("profile.finger_force_n"))
        );
        let found: Vec<_> =
            region.ranges.iter().map(|range| (range.largest, range.is_whole_list, &*range.passes_again_at)).collect();
        let (whole, gap) = ((Some(0.2), true, &[][..]), (Some(0.0), false, &[0.2][..]));
        assert_eq!(found, [whole, whole, whole, gap, gap, whole]);
        assert_eq!(region.planes.iter().map(|plane| plane.regions).collect::<Vec<_>>(), [1, 1]);
        assert_eq!(region.ranges[3].values, json!({ "controller.law": "deadbeat", "profile.finger_force_n": 0.0 }));
        assert_eq!(region.ranges[3].result_texts(), ["0", "0.2"]);
        assert!(region.island_lines()[0].starts_with("no islands: 0 of 2 maps"), "{:?}", region.island_lines());
    }

    #[test]
    fn at_most_20_combinations_are_on_the_console() {
        let vary = "\"profile.finger_force_n\" = { steps = [0.0, 2.0, 21] }\n\
            \"controller.period_ms\" = { each = [0.5, 1.0, 2.0] }\n";
        let region = region(vary, |draws| draws[1] == 1.0).unwrap();
        assert_eq!(region.axis, "controller.period_ms");
        let (blocks, further) = region.blocks();
        let rows = |block: &Block| if let Block::Table(table) = block { table.rows.len() } else { 0 };
        assert_eq!((blocks.iter().map(rows).sum::<usize>(), further.as_ref().map(rows)), (20, Some(1)));
        assert!(region.island_lines()[0].starts_with("islands: 1 of 1 maps"), "{:?}", region.island_lines());
        assert_eq!(region.planes[0].regions, 2);
    }

    #[test]
    fn there_is_no_axis_without_listed_numbers() {
        assert_eq!(region("\"controller.law\" = { each = [\"dq-pi\", \"deadbeat\"] }\n", |_| false), None);
    }
}
