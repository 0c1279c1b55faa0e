//! Applies planned faults to samples and commands: loss, damage, repetition, delay, noise. The
//! handshake, the configuration and the request for 0 V always pass, so that no fault prevents 0 V.
//! Equal trials get equal faults, because only instants and seeds determine them. In lockstep, a
//! lost sample still advances the target's time, so that its watchdog acts. The line keeps the
//! order, so that messages after a delayed one wait. `docs/scenarios.md` describes the effects.

mod inject;
mod injector;
mod packet;
mod real_time;
mod trial_clock;
mod wire_fault;

pub use injector::FaultInjector;
pub use wire_fault::{Direction, WireFault, WireFaultKind};

#[cfg(test)]
mod tests;
