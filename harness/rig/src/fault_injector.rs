//! Loses, damages, repeats, delays or floods samples and commands as planned. The handshake, the
//! configuration and `Safe` always pass, so that no fault prevents 0 V. Equal trials get equal
//! faults, because only instants and seeds determine them. In lockstep, a lost sample still
//! advances the target's time, so that its watchdog acts. The line keeps the order, so messages
//! after a delayed one wait. `docs/scenarios.md` describes the effects.

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
