//! Describes a scenario's forces and temperatures as actions for the operator.

use platebench_model::scenario::Scenario;
use platebench_plate::{Profile, Time};

const COUNTDOWN_STEPS_S: [u32; 4] = [3, 2, 1, 0];
/// If two actions are closer in time, only the earlier one is announced.
const MIN_PROMPT_SPACING: Time = Time::from_nanos(500_000_000);

#[derive(Debug, Clone, PartialEq)]
struct Prompt {
    at: Time,
    what: String,
}

#[derive(Debug)]
pub(super) struct Prompts {
    list: Vec<Prompt>,
    /// Time of the announcement, seconds until the action, and index in `list`.
    schedule: Vec<(Time, u32, usize)>,
    next: usize,
}

fn force_prompt(force_n: f64) -> String {
    if force_n == 0.0 {
        "take the finger off the plate".to_owned()
    } else {
        format!("press the plate with {force_n} N and hold")
    }
}

fn temperature_prompt(scenario: &Scenario, offset_k: f64) -> String {
    let reference = scenario.plate.reference_temperature_c;
    format!("bring the plate to {} °C ({offset_k:+} K)", ((reference + offset_k) * 1e3).round() / 1e3)
}

pub(super) fn initial_prompts(scenario: &Scenario) -> Vec<String> {
    let start = scenario.conditions.at(Time::ZERO);
    let mut asked = Vec::new();
    if start.temperature_offset_k != 0.0 {
        asked.push(temperature_prompt(scenario, start.temperature_offset_k));
    }
    asked.push(if start.finger_force_n == 0.0 {
        "leave the plate untouched".to_owned()
    } else {
        force_prompt(start.finger_force_n)
    });
    asked
}

impl Prompts {
    pub(super) fn from_scenario(scenario: &Scenario) -> Self {
        let scene = &scenario.conditions;
        let mut prompts = profile_prompts(&scene.finger_force_n, scenario.duration, force_prompt);
        prompts.extend(profile_prompts(&scene.temperature_offset_k, scenario.duration, |offset| {
            temperature_prompt(scenario, offset)
        }));
        prompts.sort_by_key(|prompt| prompt.at);
        let mut schedule: Vec<(Time, u32, usize)> = Vec::new();
        for (number, prompt) in prompts.iter().enumerate() {
            let instants =
                COUNTDOWN_STEPS_S.map(|left| (prompt.at.as_nanos().checked_sub(u64::from(left) * 1_000_000_000), left));
            schedule.extend(instants.into_iter().filter_map(|(at, left)| Some((Time::from_nanos(at?), left, number))));
        }
        schedule.sort_by_key(|(at, left, _)| (*at, *left));
        Self { list: prompts, schedule, next: 0 }
    }

    pub(super) fn next_due(&mut self, now: Time) -> Option<(&str, u32)> {
        let (at, left, number) = *self.schedule.get(self.next)?;
        if at > now {
            return None;
        }
        self.next += 1;
        self.list.get(number).map(|prompt| (prompt.what.as_str(), left))
    }
}

fn profile_prompts(profile: &Profile, duration: Time, word: impl Fn(f64) -> String) -> Vec<Prompt> {
    if let Profile::Sine { mean, amplitude, omega, .. } = profile {
        let hertz = omega / std::f64::consts::TAU;
        let what = format!("{}, then vary this value by ±{amplitude} at {hertz} Hz", word(*mean));
        return if *amplitude == 0.0 { Vec::new() } else { vec![Prompt { at: Time::ZERO, what }] };
    }
    let mut prompts: Vec<Prompt> = Vec::new();
    let points = std::iter::successors(Some(Time::ZERO), |point| profile.next_point_after(*point));
    let mut before = profile.at(Time::ZERO);
    for point in points.take_while(|point| *point < duration) {
        // The prompt for a linear segment states the value at its end.
        let (until, goal) = match (profile, profile.next_point_after(point)) {
            (Profile::Linear(_), Some(next)) => (Some(next), profile.at(next)),
            _ => (None, profile.at(point)),
        };
        let is_new = goal != before && prompts.last().is_none_or(|last| point >= last.at + MIN_PROMPT_SPACING);
        if is_new {
            let slowly = until.map_or_else(String::new, |until| format!(", as a ramp until {} s", until.seconds()));
            prompts.push(Prompt { at: point, what: word(goal) + &slowly });
        }
        before = if is_new { goal } else { profile.at(point) };
    }
    prompts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(value: f64) -> Time {
        Time::from_ms(value).unwrap()
    }

    fn prompt_texts(profile: &Profile) -> Vec<(f64, String)> {
        profile_prompts(profile, ms(60_000.0), force_prompt)
            .into_iter()
            .map(|prompt| (prompt.at.ms(), prompt.what))
            .collect()
    }

    #[test]
    fn announces_levels_and_ramps_at_their_start() {
        assert_eq!(prompt_texts(&Profile::constant(2.0)), []);
        let held = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(5_000.0), 2.0), (ms(9_000.0), 0.0)]);
        let expected = [(5_000.0, force_prompt(2.0)), (9_000.0, "take the finger off the plate".to_owned())];
        assert_eq!(prompt_texts(&held), expected);
        let line = Profile::Linear(vec![(Time::ZERO, 0.0), (ms(5_000.0), 0.0), (ms(9_000.0), 1.5)]);
        assert_eq!(
            prompt_texts(&line),
            [(5_000.0, "press the plate with 1.5 N and hold, as a ramp until 9 s".to_owned())]
        );
        assert_eq!(profile_prompts(&held, ms(5_000.0), force_prompt), []);
        let fast = Profile::Hold((0..20).map(|n| (ms(f64::from(n) * 100.0), f64::from(n))).collect());
        assert_eq!(prompt_texts(&fast).iter().map(|(at, _)| *at).collect::<Vec<_>>(), [100.0, 600.0, 1_100.0, 1_600.0]);
    }

    #[test]
    fn counts_down_each_action_once() {
        let path =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
        let mut scenario = platebench_model::scenario::load(&path, "s.toml").unwrap_or_else(|fault| panic!("{fault}"));
        scenario.duration = ms(10_000.0);
        scenario.conditions.finger_force_n = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(2_500.0), 2.0)]);
        scenario.conditions.temperature_offset_k = Profile::constant(9.0);
        assert_eq!(initial_prompts(&scenario), ["bring the plate to 33 °C (+9 K)", "leave the plate untouched"]);
        let mut prompts = Prompts::from_scenario(&scenario);
        assert_eq!(prompts.next_due(ms(499.0)), None);
        let mut announced = Vec::new();
        for at in [500.0, 501.0, 2_400.0, 2_500.0, 9_000.0] {
            while let Some((_, left)) = prompts.next_due(ms(at)) {
                announced.push((at, left));
            }
        }
        assert_eq!(announced, [(500.0, 2), (2_400.0, 1), (2_500.0, 0)]);
    }
}
