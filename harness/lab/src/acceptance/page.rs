//! Renders `record.html`: a session on one page to read, print and sign.

use crate::acceptance::session_record::{
    DecisionRecord, EvidenceRecord, RequirementRecord, STEPS, SessionRecord, StepRecord,
};
use platebench_document::{Block, Cell, Column, Document, Table};
use platebench_model::quoted;
use platebench_model::record::Verdict;

pub const FILE: &str = "record.html";

pub fn document(session: &SessionRecord) -> Document {
    let mut blocks = vec![Block::Verdict(session.verdict, summary(session))];
    blocks.extend(session.no_board_notice().map(|line| Block::paragraph(format!("{line}."))));
    blocks.push(Block::Facts(people(session)));
    blocks.extend([Block::heading("Requirements"), Block::Table(requirements(session)), Block::heading("Steps")]);
    if !session.resumed.is_empty() {
        let resumed = session.resumed.join(", ");
        blocks.push(Block::paragraph(format!("The session was interrupted and resumed: {resumed}.")));
    }
    blocks.extend([Block::Table(steps(session)), Block::heading("Evidence"), Block::Table(evidence(session))]);
    blocks.extend(session.decision.iter().flat_map(decision));
    blocks.extend([
        Block::heading("Environment"),
        Block::Facts(environment(session)),
        Block::Table(hashes(session)),
        Block::heading("Signatures"),
        Block::paragraph(session.signature.as_ref().map_or_else(
            || "This record has no electronic signature.".to_owned(),
            |signature| {
                let algorithm = &signature.algorithm;
                format!("manifest.sha256 is signed with an {algorithm} key; the public key is in session.json.")
            },
        )),
        signature_form(),
        Block::paragraph(
            "manifest.sha256 lists every file of this record. platebench acceptance verify judges the traces again; \
             sha256sum -c manifest.sha256 checks the files alone.",
        ),
    ]);
    Document { lead: format!("Acceptance record · {}", session.started), ..Document::new(&session.title, blocks) }
}

fn summary(session: &SessionRecord) -> String {
    let of = |wanted| session.requirements.iter().filter(|requirement| requirement.verdict == wanted).count();
    let (failed, open) = (of(Verdict::Fail), of(Verdict::Inconclusive));
    format!(
        "{} of {} requirements passed, {failed} failed, {open} inconclusive",
        of(Verdict::Pass),
        session.requirements.len()
    )
}

fn facts<const N: usize>(facts: [(&str, String); N]) -> Vec<(String, String)> {
    facts.map(|(name, value)| (name.to_owned(), value)).into()
}

fn people(session: &SessionRecord) -> Vec<(String, String)> {
    let stated = |text: &Option<String>| text.clone().unwrap_or_else(|| "not stated".to_owned());
    let firmware = session.firmware.as_ref().map_or_else(
        || "not identified".to_owned(),
        |found| format!("{} {}, build {}", quoted(&found.firmware.name), found.firmware.version, found.firmware.build),
    );
    let board = session.firmware.as_ref().map_or_else(
        || "unknown".to_owned(),
        |found| format!("{}; chip {}, number {}", session.rig, found.firmware.chip, found.unique),
    );
    let board = if session.no_board_notice().is_some() { format!("none ({})", session.rig) } else { board };
    facts([
        ("Operator", stated(&session.details.operator)),
        ("Place", stated(&session.details.place)),
        ("Board", board),
        ("Firmware", firmware),
        ("Begun", session.started.clone()),
        ("Ended", stated(&session.finished)),
        ("Notes", stated(&session.details.notes)),
    ])
}

fn requirements(session: &SessionRecord) -> Table {
    let met = Column::number("Expectations met", "");
    let mut table = Table::new(["Requirement".into(), "Text".into(), met, "Verdict".into()]);
    table.extend(session.requirements.iter().map(|requirement| {
        let RequirementRecord { id, text, verdict, .. } = requirement;
        [id.into(), text.into(), evidence_summary(requirement).into(), Cell::verdict(*verdict)]
    }));
    table
}

fn evidence_summary(requirement: &RequirementRecord) -> String {
    let met = requirement.evidence.iter().filter(|evidence| evidence.verdict == Verdict::Pass).count();
    match requirement.evidence.len() {
        0 => "none".to_owned(),
        all => format!("{met} of {all}"),
    }
}

fn steps(session: &SessionRecord) -> Table {
    let mut table = Table::new(["Step", "Result", "Verdict"]);
    table.extend(session.steps.iter().map(|step| {
        let link = step.run_sha256.is_some().then(|| report_of_step(&step.id));
        let title = Cell::from(&step.title).with_link(link).with_notes([step.id.clone()]);
        [title, step_result(step), step.verdict.map_or_else(|| "–".into(), Cell::verdict)]
    }));
    table
}

fn report_of_step(step: &str) -> String {
    format!("{STEPS}/{step}/report.html")
}

fn step_result(step: &StepRecord) -> Cell {
    let answer = step.answer.as_ref().map(|answer| {
        let text = answer.text.as_ref().map_or_else(|| "no answer".to_owned(), |text| format!("“{text}”"));
        format!("{text} ({})", answer.from.replace('-', " "))
    });
    let lost = step.lost.then(|| "The controller was lost or did not confirm 0 V.".to_owned());
    let parts: Vec<String> = [answer, step.reason.clone(), lost].into_iter().flatten().collect();
    let survived = step.trust.iter().flat_map(|trust| &trust.survived);
    let mut notes: Vec<String> =
        survived.map(|name| format!("not caught: {name}{}", mutant_description(name))).collect();
    if step.attempts.len() > 1 {
        let attempts = step.attempts.iter().map(|attempt| match (&attempt.broken_off, &attempt.ended) {
            (Some(why), _) => format!("{}, {why}", attempt.started),
            (None, None) => format!("{}, cut off", attempt.started),
            (None, Some(_)) => attempt.started.clone(),
        });
        let attempts = attempts.collect::<Vec<_>>().join("; ");
        notes.push(format!("started {} times: {attempts}", step.attempts.len()));
    }
    Cell::from(parts.join(" ")).with_notes(notes)
}

fn mutant_description(name: &str) -> String {
    let known = platebench_experiments::trust::catalogue().into_iter().find(|entry| entry.name == name);
    known.map_or_else(String::new, |entry| format!(", {}", entry.description))
}

fn evidence(session: &SessionRecord) -> Table {
    let [limit, value] = ["Limit", "Value"].map(|name| Column::number(name, ""));
    let mut table =
        Table::new(["Requirement".into(), "Scenario".into(), "Metric".into(), limit, value, "Verdict".into()]);
    for requirement in &session.requirements {
        table.extend(requirement.evidence.iter().map(|evidence| {
            let found = Cell::from(evidence.found.as_deref().unwrap_or("–"));
            [
                Cell::from(&requirement.id),
                Cell::from(&evidence.scenario).with_link(Some(report_of_step(&evidence.step))),
                Cell::from(&evidence.metric).with_notes(evidence.reason.clone()),
                Cell::from(&evidence.demanded),
                found.with_notes(uncertainty_line(evidence)),
                Cell::verdict(evidence.verdict),
            ]
        }));
    }
    table
}

fn uncertainty_line(evidence: &EvidenceRecord) -> Option<String> {
    let combined = &evidence.uncertainty.as_ref()?.combined;
    let freedom = combined.degrees_of_freedom.map_or_else(|| "∞".to_owned(), |freedom| format!("{freedom:.1}"));
    Some(format!("± {:.3e} (k = {:.2}, ν = {freedom})", combined.expanded, combined.coverage_factor))
}

fn decision(decision: &DecisionRecord) -> [Block; 3] {
    let DecisionRecord { rule, title, coverage, .. } = decision;
    let mut table = Table::new(["Instrument", "Serial number", "Certificate", "Calibrated", "Valid until"]);
    table.extend(decision.instruments.iter().map(|instrument| {
        let waived = if instrument.waived { " not valid; waived by the operator" } else { "" };
        let certificate = instrument.certificate.as_deref().unwrap_or("–").to_owned();
        let due = format!("{}{waived}", instrument.due);
        [instrument.name.clone(), instrument.serial.clone(), certificate, instrument.calibrated.clone(), due]
    }));
    let percent = coverage * 100.0;
    let rule = format!("Rule: {rule}. Budget: {title}. Expanded uncertainties cover {percent:.1} %.");
    [Block::heading("Decision rule and instruments"), Block::paragraph(rule), Block::Table(table)]
}

fn environment(session: &SessionRecord) -> Vec<(String, String)> {
    let (bench, clock) = (&session.bench, &session.clock);
    facts([
        ("Bench", format!("{} {}, {}, {}", bench.tool.name, bench.tool.version, bench.host.os, bench.host.arch)),
        ("Rig", session.rig.clone()),
        ("Clock", format!("{}, time scale {}, paced by {}", clock.name, clock.time_scale, clock.pacing)),
    ])
}

fn hashes(session: &SessionRecord) -> Table {
    let image = session.firmware.as_ref().and_then(|firmware| firmware.image_sha256.as_ref());
    let mut table = Table::new(["File", "SHA-256"]);
    table.push(["bench program", &session.bench.sha256]);
    table.extend(image.map(|hash| ["firmware image", hash]));
    table.extend(std::iter::once(&session.plan).chain(&session.inputs).map(|input| [&input.file, &input.sha256]));
    table
}

fn signature_form() -> Block {
    let mut lines: Vec<String> = Vec::new();
    for role in ["Operator", "Reviewer"] {
        lines.extend([format!("{role}, name"), "Date, signature".to_owned()]);
    }
    lines.push("First 16 digits of the manifest's SHA-256, as printed by platebench acceptance verify".to_owned());
    Block::Form(lines)
}
