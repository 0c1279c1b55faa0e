//! Measures the time that a hypervisor took from this machine ("steal" in `/proc/stat`, proc(5)).

use rustix::param::clock_ticks_per_second;

/// Stolen clock ticks since the boot, summed over all processors. `None` if unknown.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StealTime(Option<u64>);

impl StealTime {
    pub(crate) fn now() -> Self {
        Self(std::fs::read_to_string("/proc/stat").ok().and_then(|text| steal_ticks(&text)))
    }

    /// The resolution is one clock tick, usually 10 ms.
    pub(crate) fn ms_until(self, later: Self) -> Option<f64> {
        let ticks = later.0?.checked_sub(self.0?)?;
        Some(ticks as f64 * 1e3 / clock_ticks_per_second() as f64)
    }
}

fn steal_ticks(stat: &str) -> Option<u64> {
    stat.lines().find_map(|line| line.strip_prefix("cpu "))?.split_whitespace().nth(7)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_eighth_number_of_all_processors() {
        let stat = "intr 7\ncpu0 9 9 9 9 9 9 9 9 9 9\ncpu  1 2 3 4 5 6 7 694 10 11\n";
        assert_eq!(steal_ticks(stat), Some(694));
        assert_eq!(steal_ticks("cpu  1 2 3 4 5 6 7\n"), None);
        assert_eq!(steal_ticks("cpu0 9 9 9 9 9 9 9 9 9 9\n"), None);
    }

    #[test]
    fn an_unknown_time_has_no_difference() {
        let [unknown, early, late] = [None, Some(3), Some(5)].map(StealTime);
        assert_eq!(early.ms_until(late), Some(2e3 / clock_ticks_per_second() as f64));
        assert_eq!(late.ms_until(early), None);
        assert_eq!(unknown.ms_until(late), None);
    }
}
