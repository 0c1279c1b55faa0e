//! Defines `explore.json`, and its document: properties, violations with their scenes, and
//! coverage.

use crate::explore::coverage::{ChangeKind, RangeCoverage};
use crate::explore::exploration::{
    Exploration, ExploreConfig, FailedRegression, FailedScene, PropertyTally, SequenceTally, UndecidedScene,
    UnjudgedRegression,
};
use crate::explore::guidance::GuidanceTally;
use crate::explore::limits::{LawProperties, OwnLaw};
use crate::explore::player::{ExploreError, violated};
use crate::explore::properties::Property;
use platebench_document::format::count;
use platebench_document::{Block, Document, Figure, Table};
use platebench_engine::SafeEnds;
use platebench_model::printable::printable;
use platebench_model::quoted;
use platebench_model::record::Verdict;
use platebench_verdict::statistics::clopper_pearson;
use platebench_wire::LawId;
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;

const CONFIDENCE: f64 = 0.95;
pub const FILE: &str = "explore.json";

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct ExploreReport {
    pub format: u32,
    /// `fail` after a violation. Otherwise `inconclusive` if a scene is undecided, a signal or the
    /// rig ended the exploration or a controller did not confirm 0 V.
    pub verdict: Verdict,
    /// True if every controller confirmed 0 V and stayed there.
    pub safe_confirmed: bool,
    /// True if a signal ended the exploration. Failing scenes are then not shrunk.
    pub is_interrupted: bool,
    /// Only if an error of the rig ended the exploration. Failing scenes are then not shrunk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stopped_by: Option<String>,
    pub envelope: String,
    /// The rig as named on the command line.
    pub rig: String,
    pub firmware: String,
    pub law: &'static str,
    /// Measured times of an own law. Its limits follow from them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub own_law: Option<OwnLaw>,
    pub seed: u64,
    pub scenes: u64,
    pub failed: u64,
    pub undecided: u64,
    /// Sequences of messages between the scenes.
    pub sequences: SequenceTally,
    /// What was reached, and what was derived from it.
    pub guidance: GuidanceTally,
    pub undecided_scenes: Vec<UndecidedScene>,
    /// Duration of the exploration without shrinking, s.
    pub elapsed_s: f64,
    /// Bounds of the share of failing scenes that the generator makes, each one-sided at 95 %.
    pub failing_share: Option<[f64; 2]>,
    pub properties: Vec<PropertyReport>,
    pub regressions: usize,
    pub failed_regressions: Vec<FailedRegression>,
    /// Scenarios of earlier explorations without a result; absent if there is none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unjudged_regressions: Vec<UnjudgedRegression>,
    /// Violations of at most three properties, one per property.
    pub violations: Vec<ViolationReport>,
    pub coverage: CoverageReport,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct PropertyReport {
    pub property: Property,
    #[serde(flatten)]
    pub tally: PropertyTally,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct ViolationReport {
    pub property: Property,
    /// Number of the scene or the sequence of messages.
    pub scene: u64,
    pub is_sequence: bool,
    pub value: Option<f64>,
    pub limit: Option<f64>,
    /// The violated rule of the protocol, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rule: Option<String>,
    /// The original scene as a scenario file.
    pub original: String,
    /// The minimal scene as a scenario file.
    pub minimal: String,
    pub minimal_value: Option<f64>,
    pub minimal_limit: Option<f64>,
    pub file: String,
    /// True if the minimal scene from the written file fails with a new controller.
    pub is_reproduced: bool,
    pub replays: u32,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct CoverageReport {
    pub ranges: Vec<RangeCoverage>,
    pub pairs: Vec<PairCoverage>,
    pub histories: BTreeMap<usize, u64>,
    /// Rules and thresholds of the protocol, and how often the sequences of messages met them.
    pub rules: Vec<RuleCoverage>,
}

#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct RuleCoverage {
    pub rule: String,
    pub count: u64,
}

#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
pub struct PairCoverage {
    pub first: &'static str,
    pub second: &'static str,
    pub count: u64,
}

impl ExploreReport {
    /// Leaves `violations` empty. The session adds them after shrinking.
    pub fn new(config: &ExploreConfig, exploration: &Exploration, rig: &str, firmware: &str) -> Self {
        let failed = exploration.failed.len() as u64;
        let sequences = exploration.sequences;
        let has_failed = failed > 0 || sequences.failed > 0 || !exploration.failed_regressions.is_empty();
        let undecided =
            exploration.undecided + sequences.undecided + undecided_count(&exploration.unjudged_regressions);
        let is_empty = exploration.scenes == 0 && exploration.regressions == 0;
        let verdict = match (has_failed, undecided > 0 || exploration.is_interrupted || is_empty) {
            (true, _) => Verdict::Fail,
            (false, false) => Verdict::Pass,
            (false, true) => Verdict::Inconclusive,
        };
        let coverage = &exploration.coverage;
        let pairs = ChangeKind::ALL.iter().flat_map(|first| ChangeKind::ALL.iter().map(move |second| (first, second)));
        Self {
            format: 1,
            verdict,
            safe_confirmed: true,
            is_interrupted: exploration.is_interrupted,
            stopped_by: None,
            envelope: config.envelope.path.display().to_string(),
            rig: rig.to_owned(),
            firmware: firmware.to_owned(),
            law: config.law.name(),
            own_law: config.law.properties().and_then(|properties| properties.own),
            seed: config.seed,
            scenes: exploration.scenes,
            failed,
            undecided: exploration.undecided,
            sequences,
            guidance: exploration.guidance,
            undecided_scenes: exploration.undecided_scenes.clone(),
            elapsed_s: exploration.elapsed.as_secs_f64(),
            failing_share: clopper_pearson(
                failed as u32,
                (exploration.scenes - exploration.undecided) as u32,
                CONFIDENCE,
            ),
            properties: exploration
                .properties
                .iter()
                .map(|(property, tally)| PropertyReport { property: *property, tally: *tally })
                .collect(),
            regressions: exploration.regressions,
            failed_regressions: exploration.failed_regressions.clone(),
            unjudged_regressions: exploration.unjudged_regressions.clone(),
            violations: Vec::new(),
            coverage: CoverageReport {
                ranges: coverage.ranges().cloned().collect(),
                pairs: pairs
                    .map(|(first, second)| PairCoverage {
                        first: first.name(),
                        second: second.name(),
                        count: coverage.pair(*first, *second),
                    })
                    .collect(),
                histories: coverage.histories.clone(),
                rules: exploration
                    .rules
                    .counts()
                    .into_iter()
                    .map(|(rule, count)| RuleCoverage { rule, count })
                    .collect(),
            },
        }
    }

    /// Reason of the verdict.
    pub fn reason(&self) -> String {
        let Self { scenes, failed, undecided, failed_regressions, is_interrupted, sequences, .. } = self;
        match self.verdict {
            Verdict::Fail if sequences.failed > 0 => format!(
                "{failed} of {scenes} scenes violate a property, and {} of {} sequences of messages",
                sequences.failed, sequences.played
            ),
            Verdict::Fail if *failed == 0 && failed_regressions.is_empty() => {
                "the controller commanded a drive after it had confirmed 0 V".to_owned()
            }
            Verdict::Fail if failed_regressions.is_empty() => format!("{failed} of {scenes} scenes violate a property"),
            Verdict::Fail => format!(
                "{failed} of {scenes} scenes and {} scenarios of earlier explorations violate a property",
                failed_regressions.len()
            ),
            Verdict::Inconclusive if *is_interrupted => "a signal ended the exploration".to_owned(),
            Verdict::Inconclusive if self.stopped_by.is_some() => self.stopped_by.clone().unwrap_or_default(),
            Verdict::Inconclusive if !self.safe_confirmed => "the controller did not confirm 0 V at the end".to_owned(),
            Verdict::Inconclusive if sequences.undecided > 0 => format!(
                "{undecided} of {scenes} scenes and {} of {} sequences are undecided, because of the rig",
                sequences.undecided, sequences.played
            ),
            Verdict::Inconclusive if *undecided > 0 => {
                format!("{undecided} of {scenes} scenes are undecided, because of the rig")
            }
            Verdict::Inconclusive => format!(
                "{} scenarios of earlier explorations are undecided, because of the rig",
                undecided_count(&self.unjudged_regressions)
            ),
            Verdict::Pass => {
                format!("no property was violated in {scenes} scenes and {} sequences of messages", sequences.played)
            }
        }
    }

    pub(crate) fn record_stop(&mut self, error: Option<&ExploreError>) {
        self.stopped_by = error.map(ToString::to_string);
        if self.stopped_by.is_some() && self.verdict == Verdict::Pass {
            self.verdict = Verdict::Inconclusive;
        }
    }

    /// A drive after confirmed 0 V is a failure. A pass also needs confirmed 0 V.
    pub(crate) fn record_ends(&mut self, ends: &SafeEnds) {
        self.safe_confirmed = ends.are_confirmed();
        if ends.have_drive() {
            self.verdict = Verdict::Fail;
        } else if self.verdict == Verdict::Pass && !self.safe_confirmed {
            self.verdict = Verdict::Inconclusive;
        }
    }

    pub fn conclusion(&self) -> String {
        let Self { failed, scenes, .. } = self;
        let interrupted = match &self.stopped_by {
            Some(error) => format!(" The exploration ended early: {}.", printable(error)),
            None if self.is_interrupted => " A signal ended the exploration.".to_owned(),
            None => String::new(),
        };
        let unsafe_end = if self.safe_confirmed {
            ""
        } else {
            " The controller did not confirm 0 V or did not stay there: check the amplifier before you touch the plate."
        };
        match (failed, self.failing_share) {
            (0, Some([_, most])) if self.sequences.failed == 0 => {
                let percent = most * 100.0;
                format!(
                    "No generated scene violates a property. \
                     At 95 % confidence fewer than {percent:.3} % of all scenes fail.{interrupted}{unsafe_end}"
                )
            }
            _ if self.sequences.failed > 0 => format!(
                "{failed} of {scenes} scenes and {} of {} sequences of messages violate a property.\
                 {interrupted}{unsafe_end}",
                self.sequences.failed, self.sequences.played
            ),
            _ => format!("{failed} of {scenes} scenes violate a property.{interrupted}{unsafe_end}"),
        }
    }
}

pub(crate) fn format_value(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "no value".to_owned(), |value| format!("{value:.decimals$}"))
}

/// Violated properties, the most frequent one first, with the first scene of each.
pub fn violated_properties(exploration: &Exploration) -> Vec<(Property, &FailedScene)> {
    let mut first: BTreeMap<Property, (usize, &FailedScene)> = BTreeMap::new();
    for scene in &exploration.failed {
        for property in violated(&scene.failures) {
            first.entry(property).or_insert((0, scene)).0 += 1;
        }
    }
    let mut violated: Vec<_> = first.into_iter().collect();
    violated.sort_by_key(|(property, (count, _))| (std::cmp::Reverse(*count), *property));
    violated.into_iter().map(|(property, (_, scene))| (property, scene)).collect()
}

fn undecided_count(regressions: &[UnjudgedRegression]) -> u64 {
    regressions.iter().filter(|regression| regression.is_undecided).count() as u64
}

/// Name of the page in the run folder.
pub const PAGE_FILE: &str = "report.html";

/// Size of a field of a drawing, and width of the names next to the fields, px.
const FIELD: usize = 22;
const NAMES: usize = 210;

pub fn document(report: &ExploreReport) -> Document {
    let ExploreReport { verdict, scenes, law, envelope, rig, firmware, seed, elapsed_s, .. } = report;
    let mut failures = Vec::new();
    if report.undecided > 0 {
        failures.push(format!("{} undecided:", count(report.undecided as usize, "scene")));
        let undecided = report.undecided_scenes.iter();
        failures.extend(undecided.map(|UndecidedScene { scene, cause }| format!("  scene {scene}: {cause}")));
    }
    failures.extend(report.failed_regressions.iter().map(|FailedRegression { file, properties }| {
        let properties: Vec<_> = properties.iter().map(|property| property.name()).collect();
        format!("{file} (a scenario of an earlier exploration) still violates: {}", properties.join(", "))
    }));
    failures.extend(report.unjudged_regressions.iter().map(|UnjudgedRegression { file, reason, is_undecided }| {
        let outcome = if *is_undecided { "undecided" } else { "not applicable" };
        format!("{file} (a scenario of an earlier exploration): {outcome}: {reason}")
    }));
    for violation in &report.violations {
        let [value, limit] = [violation.minimal_value, violation.minimal_limit].map(|value| format_value(value, 6));
        let difference = violation.rule.clone().unwrap_or_else(|| format!("value {value}, limit {limit}"));
        let ViolationReport { property, file, is_sequence, .. } = violation;
        let what = if *is_sequence { "sequence" } else { "scene" };
        failures.push(format!("property {property} violated: {difference}; minimal {what}: {file}"));
        if !violation.is_reproduced {
            let why = "this scene did not fail again with a new controller, or the exploration ended before";
            failures.push(format!("  {why}"));
        }
    }
    let mut details: Vec<Block> = report.violations.iter().flat_map(violation_blocks).collect();
    details.extend([
        Block::heading("Coverage"),
        Block::paragraph(
            "The drawings show how many values of each quantity lie in each tenth of its range, and how often one \
             change followed another. A darker field has a higher count; an empty field has the count 0.",
        ),
        Block::Figures(figures(&report.coverage)),
        Block::Table(ranges(&report.coverage)),
        Block::heading("Rules of the protocol"),
        Block::Table(rules(&report.coverage)),
    ]);
    let mut blocks = vec![
        Block::paragraph(format!("{scenes} scenes of {envelope} for {law}, seed {seed}, {elapsed_s:.1} s")),
        Block::paragraph(limits(law, report.own_law)),
        Block::paragraph(sequences(&report.sequences)),
        Block::paragraph(guidance(&report.guidance)),
        Block::paragraph(unmet_rules(&report.coverage)),
        Block::Table(properties(report)),
    ];
    blocks.extend((!failures.is_empty()).then(|| Block::lines(failures)));
    blocks.extend([Block::paragraph(report.conclusion()), Block::Details(details)]);
    let lead = format!("{envelope}, seed {seed}, on {rig}, controller {}.", quoted(firmware));
    Document { lead, ..Document::new(format!("{verdict}: exploration of {law}"), blocks) }
}

fn limits(law: &str, own: Option<OwnLaw>) -> String {
    if let Some(OwnLaw { settling_us, steady_us, rest_us, .. }) = own {
        let [settling_ms, steady_ms, rest_ms] = [settling_us, steady_us, rest_us].map(|us| f64::from(us) / 1e3);
        return format!(
            "the limits follow from the longest times of its steps: settled after {settling_ms:.1} ms, steady after \
             {steady_ms:.1} ms, drive near 0 Vpp after {rest_ms:.1} ms; deviation, delayed-response and reference do \
             not apply"
        );
    }
    if LawId::from_name(law).and_then(LawProperties::of).is_some() {
        return "all properties apply".to_owned();
    }
    let without = Property::ALL.iter().filter(|property| property.needs_limits()).map(|property| property.name());
    format!("{law} has no limits, so these properties do not apply: {}", without.collect::<Vec<_>>().join(", "))
}

fn sequences(tally: &SequenceTally) -> String {
    let SequenceTally { played, messages, skipped, failed, .. } = tally;
    let skipped = if *skipped > 0 { format!("; {skipped} too long for this rig") } else { String::new() };
    format!("{played} sequences with {messages} messages, {failed} failed{skipped}")
}

fn guidance(tally: &GuidanceTally) -> String {
    let GuidanceTally { branch_outcomes, reached_branch_outcomes, .. } = *tally;
    let GuidanceTally { other_features, derived_scenes, derived_sequences, parents, .. } = *tally;
    let branches = match branch_outcomes {
        0 => String::new(),
        count => format!("{reached_branch_outcomes} of {count} branch outcomes of the image and "),
    };
    format!(
        "reached {branches}{other_features} states, causes, margins and thresholds; {derived_scenes} scenes and \
         {derived_sequences} sequences derived from {parents} that reached something new"
    )
}

fn properties(report: &ExploreReport) -> Table {
    let mut table = Table::new(["property", "windows", "violations", "smallest margin", "in scene"]);
    table.extend(report.properties.iter().map(|PropertyReport { property, tally }| {
        let margin = tally.smallest_margin;
        // A count with the limit 0 has no distance from it.
        let has_margin = margin.is_finite() && !matches!(property, Property::Protocol | Property::Answers);
        vec![
            property.to_string(),
            tally.windows.to_string(),
            tally.violations.to_string(),
            if has_margin { format!("{:.1} %", margin * 100.0) } else { "–".to_owned() },
            tally.tightest_scene.to_string(),
        ]
    }));
    table
}

fn violation_blocks(violation: &ViolationReport) -> [Block; 6] {
    let measured = |value, limit| format!("measured {}, limit {}", format_value(value, 6), format_value(limit, 6));
    let reproduced = if violation.is_reproduced { "" } else { " The scene did not fail again with a new controller." };
    [
        Block::Heading(format!("Violated: {}", violation.property)),
        Block::Paragraph(format!(
            "Minimal scene, {}.{reproduced} Its file is {}.",
            measured(violation.minimal_value, violation.minimal_limit),
            violation.file
        )),
        Block::Preformatted(violation.minimal.clone()),
        Block::Paragraph(format!(
            "Original {} {}, {}.",
            if violation.is_sequence { "sequence" } else { "scene" },
            violation.scene,
            measured(violation.value, violation.limit)
        )),
        Block::Preformatted(violation.original.clone()),
        Block::Paragraph(format!("The search for the minimal scene took {} replays.", violation.replays)),
    ]
}

fn rules(coverage: &CoverageReport) -> Table {
    let mut table = Table::new(["rule or threshold", "messages"]);
    table.extend(coverage.rules.iter().map(|RuleCoverage { rule, count }| vec![rule.clone(), count.to_string()]));
    table
}

fn unmet_rules(coverage: &CoverageReport) -> String {
    let unmet: Vec<_> = coverage.rules.iter().filter(|rule| rule.count == 0).map(|rule| &*rule.rule).collect();
    let met = coverage.rules.len() - unmet.len();
    let never = if unmet.is_empty() { String::new() } else { format!("; never exercised: {}", unmet.join(", ")) };
    format!("{met} of {} rules and thresholds of the protocol exercised{never}", coverage.rules.len())
}

fn ranges(coverage: &CoverageReport) -> Table {
    let mut table = Table::new(["quantity", "from", "to", "values", "empty tenths"]);
    table.extend(coverage.ranges.iter().map(|range| {
        let RangeCoverage { quantity, range: [low, high], counts } = range;
        let empty = counts.iter().filter(|count| **count == 0).count();
        vec![
            (*quantity).to_owned(),
            low.to_string(),
            high.to_string(),
            counts.iter().sum::<u64>().to_string(),
            empty.to_string(),
        ]
    }));
    table
}

fn figures(coverage: &CoverageReport) -> Vec<Figure> {
    let ranges: Vec<_> =
        coverage.ranges.iter().map(|range| (range.quantity.to_owned(), range.counts.to_vec())).collect();
    let mut pairs: Vec<(String, Vec<u64>)> = Vec::new();
    for pair in &coverage.pairs {
        match pairs.last_mut() {
            Some((first, counts)) if first == pair.first => counts.push(pair.count),
            _ => pairs.push((pair.first.to_owned(), vec![pair.count])),
        }
    }
    let seconds: Vec<_> = coverage.pairs.iter().take(pairs.len()).map(|pair| pair.second).collect();
    vec![
        Figure::new(fields(&ranges), "Values by tenths of their range, lowest left"),
        Figure::new(fields(&pairs), format!("First change (rows) and second change: {}", seconds.join(", "))),
    ]
}

/// Draws a row of fields per name. The opacity is the count divided by the row's largest count.
fn fields(rows: &[(String, Vec<u64>)]) -> String {
    let columns = rows.iter().map(|(_, counts)| counts.len()).max().unwrap_or(0);
    let (width, height) = (NAMES + columns * FIELD, rows.len() * FIELD);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"13\">\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>"
    );
    for (row, (name, counts)) in rows.iter().enumerate() {
        let largest = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
        let y = row * FIELD;
        let _ = write!(svg, "<text x=\"4\" y=\"{}\" fill=\"#222\">{name}</text>", y + 16);
        for (column, count) in counts.iter().enumerate() {
            let opacity = *count as f64 / largest;
            let x = NAMES + column * FIELD;
            let _ = write!(
                svg,
                "<rect x=\"{x}\" y=\"{y}\" width=\"{FIELD}\" height=\"{FIELD}\" fill=\"#0b62a4\" \
                 fill-opacity=\"{opacity:.2}\" stroke=\"#bbb\"><title>{count}</title></rect>"
            );
        }
    }
    svg.push_str("</svg>");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_field_is_transparent_and_the_largest_is_full() {
        let svg = fields(&[("one".to_owned(), vec![0, 2, 4]), ("two".to_owned(), vec![0, 0, 0])]);
        let opacities: Vec<_> = svg.split("fill-opacity=\"").skip(1).map(|rest| &rest[..4]).collect();
        assert_eq!(opacities, ["0.00", "0.50", "1.00", "0.00", "0.00", "0.00"]);
        assert!(svg.contains("height=\"44\""), "{svg}");
    }
}
