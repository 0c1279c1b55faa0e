//! Injects planned line faults: loses, damages, repeats, delays and floods messages.
//!
//! ```text
//!   FaultInjector  both directions in time order, over a link in lockstep   injector.rs
//!      ├ the same over a link in real time                                  real_time.rs
//!      └ ActiveFaults  the effect of the faults on one message              inject.rs, packet.rs
//! ```
//!
//! Faults affect samples and commands only: handshake, configuration and `Safe` pass, so that no
//! fault prevents 0 V. Instants and seeds determine them: equal trials get equal faults. In
//! lockstep a lost sample still advances the target, so that its time-out acts. A line keeps the
//! order: messages behind a delayed one wait. Effects for users: `docs/scenarios.md`.

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
