//! Lists the steps of a session.

use crate::acceptance::plan::{Ask, Plan, PlannedScenario, QuestionTime};
use crate::acceptance::session_record::{StepKind, StepRecord};

#[derive(Debug, Clone, Copy)]
pub(crate) enum StepAction<'a> {
    Identity,
    Ask(&'a Ask),
    SelfTest,
    Trust,
    Scenario(&'a PlannedScenario),
}

pub(crate) fn step_actions(plan: &Plan) -> Vec<StepAction<'_>> {
    let asks = |when| plan.asks.iter().filter(move |ask| ask.when == when).map(StepAction::Ask);
    let mut actions = vec![StepAction::Identity];
    actions.extend(asks(QuestionTime::Before));
    actions.extend([StepAction::SelfTest, StepAction::Trust]);
    actions.extend(plan.scenarios.iter().map(StepAction::Scenario));
    actions.extend(asks(QuestionTime::After));
    actions
}

pub(crate) fn step_records(plan: &Plan) -> Vec<StepRecord> {
    let describe = |action: StepAction<'_>| match action {
        StepAction::Identity => ("identity".to_owned(), "Board and firmware".to_owned(), StepKind::Identity),
        StepAction::Ask(ask) => (format!("ask-{}", ask.id), ask.question.clone(), StepKind::Ask),
        StepAction::SelfTest => {
            ("self-test".to_owned(), "Timing and repeatability of the bench".to_owned(), StepKind::SelfTest)
        }
        StepAction::Trust => {
            ("trust".to_owned(), "How well the scenarios catch faulty controllers".to_owned(), StepKind::Trust)
        }
        StepAction::Scenario(planned) => {
            let name = planned.scenario.name().replace(['/', '\\'], "-");
            (name, planned.scenario.title.clone(), StepKind::Scenario)
        }
    };
    let numbered = step_actions(plan).into_iter().enumerate();
    numbered
        .map(|(index, action)| {
            let (name, title, kind) = describe(action);
            StepRecord::new(format!("{:02}-{name}", index + 1), &title, kind)
        })
        .collect()
}
