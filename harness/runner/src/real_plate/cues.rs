//! A scenario's finger and temperature in words for a person.

use platebench_plate::{Profile, Time};
use platebench_scenario::Scenario;

/// Seconds before a cue at which it is announced.
const ANNOUNCED_S: [u32; 4] = [3, 2, 1, 0];
/// Nobody follows cues that come faster; the earlier one is said.
const APART: Time = Time::from_nanos(500_000_000);

/// Something to be done at an instant of the trial.
#[derive(Debug, Clone, PartialEq)]
struct Cue {
    at: Time,
    what: String,
}

/// What is still to be said, in order.
#[derive(Debug)]
pub(super) struct Cues {
    whole: Vec<Cue>,
    /// When each is said, with the seconds that are left then and its number.
    said: Vec<(Time, u32, usize)>,
    next: usize,
}

fn press(force_n: f64) -> String {
    if force_n == 0.0 {
        "take the finger off the plate".to_owned()
    } else {
        format!("press the plate with {force_n} N and hold")
    }
}

fn warm(scenario: &Scenario, offset_k: f64) -> String {
    let reference = scenario.plate.reference_temperature_c;
    format!("bring the plate to {} °C ({offset_k:+} K)", ((reference + offset_k) * 1e3).round() / 1e3)
}

/// What has to be so when the trial starts, in the order in which a person can do it.
pub(super) fn at_the_start(scenario: &Scenario) -> Vec<String> {
    let start = scenario.scene.at(Time::ZERO);
    let mut asked = Vec::new();
    if start.temperature_offset_k != 0.0 {
        asked.push(warm(scenario, start.temperature_offset_k));
    }
    asked.push(if start.finger_force_n == 0.0 {
        "leave the plate untouched".to_owned()
    } else {
        press(start.finger_force_n)
    });
    asked
}

impl Cues {
    /// What is to be done within a trial of `scenario`.
    pub(super) fn of(scenario: &Scenario) -> Self {
        let scene = &scenario.scene;
        let mut cues = of_profile(&scene.finger_force_n, scenario.duration, press);
        cues.extend(of_profile(&scene.temperature_offset_k, scenario.duration, |offset| warm(scenario, offset)));
        cues.sort_by_key(|cue| cue.at);
        let mut said: Vec<(Time, u32, usize)> = Vec::new();
        for (number, cue) in cues.iter().enumerate() {
            let instants =
                ANNOUNCED_S.map(|left| (cue.at.as_nanos().checked_sub(u64::from(left) * 1_000_000_000), left));
            said.extend(instants.into_iter().filter_map(|(at, left)| Some((Time::from_nanos(at?), left, number))));
        }
        said.sort_by_key(|(at, left, _)| (*at, *left));
        Self { whole: cues, said, next: 0 }
    }

    /// The next thing to be said by `now`, with the seconds that are left for it.
    pub(super) fn due(&mut self, now: Time) -> Option<(&str, u32)> {
        let (at, left, number) = *self.said.get(self.next)?;
        if at > now {
            return None;
        }
        self.next += 1;
        self.whole.get(number).map(|cue| (cue.what.as_str(), left))
    }
}

fn of_profile(profile: &Profile, duration: Time, word: impl Fn(f64) -> String) -> Vec<Cue> {
    if let Profile::Sine { mean, amplitude, omega, .. } = profile {
        let hertz = omega / std::f64::consts::TAU;
        let what = format!("{}, then {amplitude} more and less {hertz} times a second", word(*mean));
        return if *amplitude == 0.0 { Vec::new() } else { vec![Cue { at: Time::ZERO, what }] };
    }
    let mut cues: Vec<Cue> = Vec::new();
    let points = std::iter::successors(Some(Time::ZERO), |point| profile.next_point_after(*point));
    let mut before = profile.at(Time::ZERO);
    for point in points.take_while(|point| *point < duration) {
        // Where a line starts its end is what is to be done; a level that is held is there at once.
        let (until, goal) = match (profile, profile.next_point_after(point)) {
            (Profile::Linear(_), Some(next)) => (Some(next), profile.at(next)),
            _ => (None, profile.at(point)),
        };
        let is_new = goal != before && cues.last().is_none_or(|last| point >= last.at + APART);
        if is_new {
            let slowly = until.map_or_else(String::new, |until| format!(", evenly until {} s", until.seconds()));
            cues.push(Cue { at: point, what: word(goal) + &slowly });
        }
        before = if is_new { goal } else { profile.at(point) };
    }
    cues
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(value: f64) -> Time {
        Time::from_ms(value).unwrap()
    }

    fn words(profile: &Profile) -> Vec<(f64, String)> {
        of_profile(profile, ms(60_000.0), press).into_iter().map(|cue| (cue.at.ms(), cue.what)).collect()
    }

    #[test]
    fn levels_and_lines_are_said_where_they_begin() {
        assert_eq!(words(&Profile::constant(2.0)), []);
        let held = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(5_000.0), 2.0), (ms(9_000.0), 0.0)]);
        let told = [(5_000.0, press(2.0)), (9_000.0, "take the finger off the plate".to_owned())];
        assert_eq!(words(&held), told);
        let line = Profile::Linear(vec![(Time::ZERO, 0.0), (ms(5_000.0), 0.0), (ms(9_000.0), 1.5)]);
        assert_eq!(words(&line), [(5_000.0, "press the plate with 1.5 N and hold, evenly until 9 s".to_owned())]);
        // What comes after the trial is nobody's business, and what comes too fast is said once.
        assert_eq!(of_profile(&held, ms(5_000.0), press), []);
        let fast = Profile::Hold((0..20).map(|n| (ms(f64::from(n) * 100.0), f64::from(n))).collect());
        assert_eq!(words(&fast).iter().map(|(at, _)| *at).collect::<Vec<_>>(), [100.0, 600.0, 1_100.0, 1_600.0]);
    }

    #[test]
    fn a_cue_is_counted_down_and_said_once() {
        let path =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
        let mut scenario = platebench_scenario::load(&path, "s.toml").unwrap_or_else(|fault| panic!("{fault}"));
        scenario.duration = ms(10_000.0);
        scenario.scene.finger_force_n = Profile::Hold(vec![(Time::ZERO, 0.0), (ms(2_500.0), 2.0)]);
        scenario.scene.temperature_offset_k = Profile::constant(9.0);
        assert_eq!(at_the_start(&scenario), ["bring the plate to 33 °C (+9 K)", "leave the plate untouched"]);
        let mut cues = Cues::of(&scenario);
        assert_eq!(cues.due(ms(499.0)), None);
        let mut said = Vec::new();
        for at in [500.0, 501.0, 2_400.0, 2_500.0, 9_000.0] {
            while let Some((_, left)) = cues.due(ms(at)) {
                said.push((at, left));
            }
        }
        assert_eq!(said, [(500.0, 2), (2_400.0, 1), (2_500.0, 0)]);
    }
}
