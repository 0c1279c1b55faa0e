//! A plan under way: played on threads of its own, listened to, and ended by signals.

use crate::desk::Desk;
use crate::guard::Busy;
use crate::signals::{PATIENCE, Signals};
use platebench_live::{Told, View};
use platebench_report::events::Events;
use platebench_report::{Progress, ProgressKind};
use platebench_rig::RigSpec;
use platebench_runner::{Cancel, Clock, Company, Event, Plan, RunError, RunFolder, Watch};
use platebench_verdict::RunRecord;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;

/// Whoever follows a run that is to end has so long for what it was told.
const HEARD_WITHIN: Duration = Duration::from_secs(1);
const ASK_AGAIN: Duration = Duration::from_millis(1);

/// Who hears of a run while it is played.
pub(crate) struct Audience<'a> {
    pub(crate) progress: Progress,
    pub(crate) view: Option<&'a View>,
    pub(crate) events: Option<&'a mut Events>,
}

impl Audience<'_> {
    /// Nobody.
    pub(crate) fn nobody() -> Self {
        Self { progress: Progress::new(ProgressKind::Quiet), view: None, events: None }
    }

    fn hear(&mut self, event: &Event) {
        follow(&mut self.progress, event);
        if let (Some(view), Some(news)) = (self.view, Told::of(event)) {
            view.tell(news);
        }
        if let Some(events) = &mut self.events {
            tell(events, event);
        }
    }
}

/// Plays the plan on threads of its own while this one listens for signals and tells of progress.
pub(crate) fn play(
    plan: Plan,
    folder: &RunFolder,
    rig: RigSpec,
    desk: Desk,
    watch: Watch,
    mut audience: Audience<'_>,
) -> Result<RunRecord, (RunError, Option<u8>)> {
    let without_signal = |error: std::io::Error| (RunError::Bench(error.to_string()), None);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(without_signal)?;
    let cancel = Cancel::default();
    let result = runtime.block_on(async {
        let mut signals = Signals::listen().map_err(without_signal)?;
        let (teller, mut events) = mpsc::channel::<Event>(64);
        let busy = Busy::begin(&cancel);
        let mut playing = {
            let (folder, cancel) = (folder.clone(), cancel.clone());
            tokio::task::spawn_blocking(move || {
                let _busy = busy;
                let mut asked = None;
                let mut tell = |event| send(&teller, event, &cancel, &mut asked);
                let connect = || match plan.clock {
                    Clock::Lockstep { .. } => rig.connect(),
                    Clock::RealTime(_) | Clock::OwnPlate => rig.connect_in_real_time(),
                };
                let company = Company { person: &desk, watch: &watch };
                platebench_runner::run_in_company(&plan, &folder, &connect, &cancel, company, &mut tell)
            })
        };
        let mut received = None;
        let mut asked = None;
        loop {
            let number = tokio::select! {
                Some(event) = events.recv() => {
                    audience.hear(&event);
                    continue;
                }
                ended = &mut playing => {
                    // What was said before the end may not have been heard yet.
                    while let Ok(event) = events.try_recv() {
                        audience.hear(&event);
                    }
                    audience.progress.finish();
                    let ended = ended.unwrap_or_else(|error| Err(RunError::Bench(error.to_string())));
                    return ended.map_err(|error| (error, received));
                }
                number = signals.next() => number,
            };
            let first = *asked.get_or_insert_with(Instant::now);
            // A closing terminal asks twice by itself: nobody is left alone with the drive before it had time to go to 0 V.
            if first.elapsed() > PATIENCE {
                return Err((RunError::Cancelled, received));
            }
            received.get_or_insert(number);
            cancel.cancel();
        }
    });
    // A trial that does not come back is not waited for.
    runtime.shutdown_background();
    result
}

/// Tells `event`; where nobody listens any more, or does not come to it once the end was asked for, which was seen at `asked`, it is not told.
fn send(teller: &mpsc::Sender<Event>, mut event: Event, cancel: &Cancel, asked: &mut Option<Instant>) {
    while let Err(TrySendError::Full(back)) = teller.try_send(event) {
        if cancel.is_cancelled() && asked.get_or_insert_with(Instant::now).elapsed() > HEARD_WITHIN {
            return;
        }
        event = back;
        std::thread::sleep(ASK_AGAIN);
    }
}

/// Shows what happened.
pub(crate) fn follow(progress: &mut Progress, event: &Event) {
    match event {
        Event::ScenarioStarted { file, trials } => progress.scenario_started(file, *trials),
        Event::TrialFinished { file, trial } => progress.trial_finished(file, trial.index),
        Event::ScenarioFinished(record) => progress.scenario_finished(record),
    }
}

fn tell(events: &mut Events, event: &Event) {
    match event {
        Event::ScenarioStarted { file, trials } => events.scenario_started(file, *trials),
        Event::TrialFinished { file, trial } => events.trial_finished(file, trial),
        Event::ScenarioFinished(record) => events.scenario_finished(record),
    }
}
