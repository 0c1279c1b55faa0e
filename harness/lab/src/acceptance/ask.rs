//! Asks a question of the plan and records the answer.

use crate::acceptance::error::AcceptError;
use crate::acceptance::plan::{AnswerKind, Ask, QuestionTime};
use crate::acceptance::session_record::{AnswerRecord, StepRecord};
use platebench_engine::{Answer, CancelToken, Operator, Question, QuestionKind};
use platebench_model::record::Verdict;
use platebench_rig::RigSpec;

/// Asks the question and stores the answer in `step`. Before the first scenario, a no stops the
/// session. A missing answer stops it if the rig may drive a plate.
pub(crate) fn ask_operator(
    ask: &Ask,
    rig: &RigSpec,
    step: &mut StepRecord,
    operator: &dyn Operator,
    cancel: &CancelToken,
) -> Result<(), AcceptError> {
    let kind = match ask.answer {
        AnswerKind::Confirm => QuestionKind::Confirm,
        AnswerKind::Text => QuestionKind::Text,
        AnswerKind::Number => QuestionKind::Number,
    };
    let answer = operator.ask(Question { text: &ask.question, kind }, cancel);
    if cancel.is_cancelled() {
        return Err(AcceptError::Cancelled);
    }
    if ask.answer == AnswerKind::Confirm {
        if ask.when == QuestionTime::Before && !answer.is_yes() {
            let question = ask.question.clone();
            match answer {
                Answer::Absent if !rig.is_simulated() => {
                    return Err(AcceptError::Unanswered { question, rig: rig.to_string() });
                }
                Answer::Absent => {}
                Answer::Terminal(_) | Answer::CommandLine(_) => return Err(AcceptError::AnsweredNo(question)),
            }
        }
        step.verdict = Some(if answer.is_yes() { Verdict::Pass } else { Verdict::Inconclusive });
        step.reason = match answer.text() {
            None => Some("no answer".to_owned()),
            Some(_) if !answer.is_yes() => Some("the answer was no".to_owned()),
            Some(_) => None,
        };
    }
    let from = match answer {
        Answer::Terminal(_) => "terminal",
        Answer::CommandLine(_) => "command-line",
        Answer::Absent => "not-asked",
    };
    step.answer = Some(AnswerRecord { text: answer.text().map(str::to_owned), from: from.to_owned() });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acceptance::session_record::StepKind;
    use rstest::rstest;

    struct FixedAnswer(Answer);

    impl Operator for FixedAnswer {
        fn ask(&self, _: Question<'_>, _: &CancelToken) -> Answer {
            self.0.clone()
        }
    }

    fn ask_with_answer(
        rig: &str,
        answer: AnswerKind,
        when: QuestionTime,
        given: Answer,
    ) -> Result<StepRecord, AcceptError> {
        let ask = Ask { id: "safe".to_owned(), question: "Is it safe?".to_owned(), answer, when };
        let mut step = StepRecord::new("02-ask-safe".to_owned(), &ask.question, StepKind::Ask);
        ask_operator(&ask, &rig.parse().unwrap(), &mut step, &FixedAnswer(given), &CancelToken::never()).map(|()| step)
    }

    const BOARD_RIGS: [&str; 4] =
        ["serial:/dev/ttyUSB0", "exec:a {port}", "probe:STM32F407VG", "probe:STM32F407VG,elf=a"];
    const SIMULATED_RIGS: [&str; 3] = ["hosted", "emulated", "emulated:a.elf"];

    #[test]
    fn a_rig_with_a_board_needs_a_confirmation() {
        for rig in BOARD_RIGS {
            let stopped = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Absent).unwrap_err();
            assert!(matches!(&stopped, AcceptError::Unanswered { question, .. } if question == "Is it safe?"), "{rig}");
            let message = stopped.to_string();
            assert!(message.contains(rig) && message.contains("--yes"), "{message}");
        }
        for rig in SIMULATED_RIGS {
            let step = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Absent).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive), "{rig}");
        }
    }

    #[rstest]
    #[case::terminal(Answer::Terminal("yes".to_owned()))]
    #[case::command_line(Answer::CommandLine("yes".to_owned()))]
    fn yes_continues_and_no_stops_on_every_rig(#[case] yes: Answer) {
        for rig in BOARD_RIGS.iter().chain(&SIMULATED_RIGS) {
            let step = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, yes.clone()).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Pass), "{rig}");
            let no = ask_with_answer(rig, AnswerKind::Confirm, QuestionTime::Before, Answer::Terminal("no".to_owned()));
            assert!(matches!(no, Err(AcceptError::AnsweredNo(_))), "{rig}");
        }
    }

    #[test]
    fn a_no_after_the_last_scenario_does_not_stop() {
        for given in [Answer::Absent, Answer::Terminal("no".to_owned())] {
            let step = ask_with_answer("serial:p", AnswerKind::Confirm, QuestionTime::After, given).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive));
        }
        let step = ask_with_answer("serial:p", AnswerKind::Text, QuestionTime::Before, Answer::Absent).unwrap();
        assert_eq!((step.verdict, step.answer.unwrap().text), (None, None), "a text decides nothing");
    }
}
