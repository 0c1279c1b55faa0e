//! A question of the plan, and what its answer does to the session.

use crate::error::AcceptError;
use crate::order::{Answer, Desk, Question, may_have_a_board};
use crate::plan::{AnswerKind, Ask, When};
use crate::session::{AnswerRecord, StepRecord};
use platebench_rig::RigSpec;
use platebench_runner::Cancel;
use platebench_verdict::Verdict;

/// Puts a question of the plan. What has to be confirmed before a plate may be driven is: a no and no answer alike end the session here.
pub(crate) fn asked(
    ask: &Ask,
    rig: &RigSpec,
    step: &mut StepRecord,
    desk: &mut dyn Desk,
    cancel: &Cancel,
) -> Result<(), AcceptError> {
    let answer = desk.ask(&Question { text: &ask.question, kind: ask.answer });
    if cancel.is_cancelled() {
        return Err(AcceptError::Cancelled);
    }
    let (text, from) = match answer {
        Answer::Terminal(text) => (Some(text), "terminal"),
        Answer::CommandLine(text) => (Some(text), "command-line"),
        Answer::NotAsked => (None, "not-asked"),
    };
    if ask.answer == AnswerKind::Confirm {
        let yes = text.as_deref() == Some("yes");
        if !yes && ask.when == When::Before {
            let question = ask.question.clone();
            match &text {
                Some(_) => return Err(AcceptError::Stopped(question)),
                None if may_have_a_board(rig) => {
                    return Err(AcceptError::Unanswered { question, rig: rig.to_string() });
                }
                None => {}
            }
        }
        step.verdict = Some(if yes { Verdict::Pass } else { Verdict::Inconclusive });
        step.reason = match &text {
            None => Some("nobody answered".to_owned()),
            Some(_) if !yes => Some("the answer was no".to_owned()),
            Some(_) => None,
        };
    }
    step.answer = Some(AnswerRecord { text, from: from.to_owned() });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::StepKind;
    use platebench_runner::Event;
    use rstest::rstest;

    struct Says(Answer);

    impl Desk for Says {
        fn ask(&mut self, _: &Question<'_>) -> Answer {
            self.0.clone()
        }
        fn begun(&mut self, _: &StepRecord) {}
        fn ended(&mut self, _: &StepRecord) {}
        fn event(&mut self, _: &Event) {}
    }

    fn put(rig: &str, answer: AnswerKind, when: When, said: Answer) -> Result<StepRecord, AcceptError> {
        let ask = Ask { id: "safe".to_owned(), question: "Is it safe?".to_owned(), answer, when };
        let mut step = StepRecord::new("02-ask-safe".to_owned(), &ask.question, StepKind::Ask);
        asked(&ask, &rig.parse().unwrap(), &mut step, &mut Says(said), &Cancel::default()).map(|()| step)
    }

    const REAL: [&str; 4] = ["serial:/dev/ttyUSB0", "exec:a {port}", "probe:STM32F407VG", "probe:STM32F407VG,elf=a"];
    const OURS: [&str; 3] = ["hosted", "emulated", "emulated:a.elf"];

    #[test]
    fn where_a_plate_may_be_driven_no_answer_is_a_no() {
        for rig in REAL {
            let stopped = put(rig, AnswerKind::Confirm, When::Before, Answer::NotAsked).unwrap_err();
            assert!(matches!(&stopped, AcceptError::Unanswered { question, .. } if question == "Is it safe?"), "{rig}");
            let told = stopped.to_string();
            assert!(told.contains(rig) && told.contains("--yes"), "{told}");
        }
        for rig in OURS {
            let step = put(rig, AnswerKind::Confirm, When::Before, Answer::NotAsked).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive), "{rig}");
        }
    }

    #[rstest]
    #[case::terminal(Answer::Terminal("yes".to_owned()))]
    #[case::command_line(Answer::CommandLine("yes".to_owned()))]
    fn a_yes_goes_on_and_a_no_does_not_on_any_rig(#[case] yes: Answer) {
        for rig in REAL.iter().chain(&OURS) {
            let step = put(rig, AnswerKind::Confirm, When::Before, yes.clone()).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Pass), "{rig}");
            let no = put(rig, AnswerKind::Confirm, When::Before, Answer::Terminal("no".to_owned()));
            assert!(matches!(no, Err(AcceptError::Stopped(_))), "{rig}");
        }
    }

    #[test]
    fn once_all_is_played_nothing_is_left_to_stop() {
        for said in [Answer::NotAsked, Answer::Terminal("no".to_owned())] {
            let step = put("serial:p", AnswerKind::Confirm, When::After, said).unwrap();
            assert_eq!(step.verdict, Some(Verdict::Inconclusive));
        }
        let step = put("serial:p", AnswerKind::Text, When::Before, Answer::NotAsked).unwrap();
        assert_eq!((step.verdict, step.answer.unwrap().text), (None, None), "a text decides nothing");
    }
}
