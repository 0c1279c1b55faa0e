use platebench_wire::{Configure, LawId};

/// Configuration for the paper's plate. The bench has the timer; 0 means the default watchdog.
pub const CONFIGURE: Configure = Configure {
    law: LawId::DqPi,
    paced_by_target: false,
    drives_own_plate: false,
    watchdog_timeout_ms: 0,
    period_us: 1_000,
    loop_delay_us: 0,
    start_frequency_mhz: 32_307_600,
    gain_um_per_vpp: 0.00698,
    time_constant_s: 1.88e-3,
    response_time_s: 0.0,
    drive_limit_vpp: 900.0,
    frequency_range_hz: 250.0,
    frequency_slew_hz: 100.0,
    gains: None,
};
