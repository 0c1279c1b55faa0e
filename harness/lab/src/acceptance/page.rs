//! Renders `record.html`: a session on one page to read, print and sign.

use crate::acceptance::session_record::{EvidenceRecord, RequirementRecord, STEPS, SessionRecord, StepRecord};
use maud::{Markup, html};
use platebench_model::record::Verdict;
use platebench_report::document::verdict_badge;
use platebench_report::page::page_frame;

pub const FILE: &str = "record.html";

const STYLE: &str = include_str!("page/style.css");

pub fn render(session: &SessionRecord) -> String {
    let title = format!("{} · {} {}", session.verdict, session.title, session.started);
    let body = html! {
        header {
            p.eyebrow { "Acceptance record · " (session.started) }
            h1 { (session.title) }
            p.lead { (badge(session.verdict)) " " (summary(session)) }
            @if let Some(line) = session.no_board_notice() { p.notice { (line) "." } }
        }
        main {
            (people_section(session))
            (requirements(session))
            (steps(session))
            (evidence(session))
            (decision_section(session))
            (environment(session))
            (signatures(session))
        }
        footer {
            p {
                "manifest.sha256 lists every file of this record. platebench acceptance verify judges the traces again; "
                "sha256sum -c manifest.sha256 checks the files alone."
            }
        }
    };
    page_frame(&title, STYLE, &html! {}, &body)
}

fn badge(verdict: Verdict) -> Markup {
    verdict_badge(verdict, verdict.name())
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

fn people_section(session: &SessionRecord) -> Markup {
    let stated = |text: &Option<String>| text.clone().unwrap_or_else(|| "not stated".to_owned());
    let firmware = session.firmware.as_ref().map_or_else(
        || "not identified".to_owned(),
        |found| format!("{} {}, build {}", found.firmware.name, found.firmware.version, found.firmware.build),
    );
    let board = session.firmware.as_ref().map_or_else(
        || "unknown".to_owned(),
        |found| format!("{}; chip {}, number {}", session.rig, found.firmware.chip, found.unique),
    );
    let board = if session.no_board_notice().is_some() { format!("none ({})", session.rig) } else { board };
    let facts = [
        ("Operator", stated(&session.details.operator)),
        ("Place", stated(&session.details.place)),
        ("Board", board),
        ("Firmware", firmware),
        ("Begun", session.started.clone()),
        ("Ended", stated(&session.finished)),
        ("Notes", stated(&session.details.notes)),
    ];
    html! {
        section { dl.facts { @for (name, value) in &facts { div { dt { (name) } dd { (value) } } } } }
    }
}

fn requirements(session: &SessionRecord) -> Markup {
    html! {
        section tabindex="0" {
            h2 { "Requirements" }
            (table(None, &["Requirement", "Text", "Expectations met", "Verdict"], &html! {
                @for requirement in &session.requirements {
                    tr {
                        th scope="row" { (requirement.id) }
                        td { (requirement.text) }
                        td.number { (evidence_summary(requirement)) }
                        td { (badge(requirement.verdict)) }
                    }
                }
            }))
        }
    }
}

fn table(class: Option<&str>, columns: &[&str], rows: &Markup) -> Markup {
    html! {
        table class=[class] {
            thead { tr { @for column in columns { th { (column) } } } }
            tbody { (rows) }
        }
    }
}

fn evidence_summary(requirement: &RequirementRecord) -> String {
    let met = requirement.evidence.iter().filter(|evidence| evidence.verdict == Verdict::Pass).count();
    match requirement.evidence.len() {
        0 => "none".to_owned(),
        all => format!("{met} of {all}"),
    }
}

fn steps(session: &SessionRecord) -> Markup {
    html! {
        section tabindex="0" {
            h2 { "Steps" }
            @if !session.resumed.is_empty() {
                p.notice { "The session was interrupted and resumed: " (session.resumed.join(", ")) "." }
            }
            (table(None, &["Step", "Result", "Verdict"], &html! { @for step in &session.steps { (step_row(step)) } }))
        }
    }
}

fn step_row(step: &StepRecord) -> Markup {
    html! {
        tr {
            th scope="row" {
                @if step.run_sha256.is_some() { a href={ (STEPS) "/" (step.id) "/report.html" } { (step.title) } }
                @else { (step.title) }
                span.file { (step.id) }
            }
            td {
                @if let Some(answer) = &step.answer {
                    @match &answer.text { Some(text) => { "“" (text) "”" }, None => "no answer" }
                    " (" (answer.from.replace('-', " ")) ") "
                }
                @if let Some(reason) = &step.reason { (reason) }
                @if let Some(trust) = &step.trust {
                    @for name in &trust.survived { span.file { "not caught: " (name) (mutant_description(name)) } }
                }
                @if step.lost { strong { " The controller was lost or did not confirm 0 V." } }
                @if step.attempts.len() > 1 {
                    span.file {
                        "started " (step.attempts.len()) " times: "
                        @for (number, attempt) in step.attempts.iter().enumerate() {
                            @if number > 0 { "; " }
                            (attempt.started)
                            @if let Some(why) = &attempt.broken_off { ", " (why) }
                            @else if attempt.ended.is_none() { ", cut off" }
                        }
                    }
                }
            }
            td { @if let Some(verdict) = step.verdict { (badge(verdict)) } @else { "–" } }
        }
    }
}

fn mutant_description(name: &str) -> String {
    let known = platebench_experiments::trust::catalogue().into_iter().find(|entry| entry.name == name);
    known.map_or_else(String::new, |entry| format!(", {}", entry.description))
}

fn evidence(session: &SessionRecord) -> Markup {
    html! {
        section tabindex="0" {
            h2 { "Evidence" }
            (table(Some("evidence"), &["Requirement", "Scenario", "Metric", "Limit", "Value", "Verdict"], &html! {
                @for requirement in &session.requirements { @for evidence in &requirement.evidence {
                    tr {
                        th scope="row" { (requirement.id) }
                        td { a href={ (STEPS) "/" (evidence.step) "/report.html" } { (evidence.scenario) } }
                        td {
                            code { (evidence.metric) }
                            @if let Some(reason) = &evidence.reason { span.file { (reason) } }
                        }
                        td.number { (evidence.demanded) }
                        td.number {
                            (evidence.found.as_deref().unwrap_or("–"))
                            @if let Some(line) = uncertainty_line(evidence) { span.file { (line) } }
                        }
                        td { (badge(evidence.verdict)) }
                    }
                } }
            }))
        }
    }
}

fn uncertainty_line(evidence: &EvidenceRecord) -> Option<String> {
    let combined = &evidence.uncertainty.as_ref()?.combined;
    let freedom = combined.degrees_of_freedom.map_or_else(|| "∞".to_owned(), |freedom| format!("{freedom:.1}"));
    Some(format!("± {:.3e} (k = {:.2}, ν = {freedom})", combined.expanded, combined.coverage_factor))
}

fn decision_section(session: &SessionRecord) -> Markup {
    html! {
        @if let Some(decision) = &session.decision {
            section tabindex="0" {
                h2 { "Decision rule and instruments" }
                p {
                    "Rule: " (decision.rule) ". Budget: " (decision.title) ". Expanded uncertainties cover "
                    (format!("{:.1}", decision.coverage * 100.0)) " %."
                }
                (table(None, &["Instrument", "Serial number", "Certificate", "Calibrated", "Valid until"], &html! {
                    @for instrument in &decision.instruments {
                        tr {
                            th scope="row" { (instrument.name) }
                            td { (instrument.serial) }
                            td { (instrument.certificate.as_deref().unwrap_or("–")) }
                            td { (instrument.calibrated) }
                            td {
                                (instrument.due)
                                @if instrument.waived { strong { " not valid; waived by the operator" } }
                            }
                        }
                    }
                }))
            }
        }
    }
}

fn environment(session: &SessionRecord) -> Markup {
    let bench = &session.bench;
    let image = session.firmware.as_ref().and_then(|firmware| firmware.image_sha256.clone());
    let facts = [
        ("Bench", format!("{} {}, {}, {}", bench.tool.name, bench.tool.version, bench.host.os, bench.host.arch)),
        ("Rig", session.rig.clone()),
        (
            "Clock",
            format!(
                "{}, time scale {}, paced by {}",
                session.clock.name, session.clock.time_scale, session.clock.pacing
            ),
        ),
    ];
    let mut hashes = vec![("bench program".to_owned(), bench.sha256.clone())];
    hashes.extend(image.map(|hash| ("firmware image".to_owned(), hash)));
    hashes.push((session.plan.file.clone(), session.plan.sha256.clone()));
    hashes.extend(session.inputs.iter().map(|input| (input.file.clone(), input.sha256.clone())));
    html! {
        section tabindex="0" {
            h2 { "Environment" }
            dl.facts { @for (name, value) in &facts { div { dt { (name) } dd { (value) } } } }
            (table(Some("hashes"), &["File", "SHA-256"], &html! {
                @for (file, hash) in &hashes { tr { th scope="row" { (file) } td { code { (hash) } } } }
            }))
        }
    }
}

fn signatures(session: &SessionRecord) -> Markup {
    html! {
        section.signatures {
            h2 { "Signatures" }
            p {
                @match &session.signature {
                    Some(signature) => {
                        "manifest.sha256 is signed with an " (signature.algorithm)
                        " key; the public key is in session.json."
                    },
                    None => "This record has no electronic signature.",
                }
            }
            div.fields {
                @for role in ["Operator", "Reviewer"] {
                    div.field { span.line {} span { (role) ", name" } }
                    div.field { span.line {} span { "Date, signature" } }
                }
                div.field.wide {
                    span.line {}
                    span { "First 16 digits of the manifest's SHA-256, as printed by platebench acceptance verify" }
                }
            }
        }
    }
}
