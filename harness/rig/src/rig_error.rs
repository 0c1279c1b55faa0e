//! Defines why a session with a controller cannot continue.

use crate::link::LinkError;
use platebench_wire::{FaultReport, Rejection};

/// Why a session cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The link is lost, or the target behind it crashed.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The target does not answer.
    #[error(
        "no {expected} from the controller; is it running, and does it speak version {} of the protocol?",
        platebench_wire::VERSION
    )]
    NoAnswer {
        /// The missing message.
        expected: &'static str,
    },
    /// The rig knows virtual time only.
    #[error("this rig cannot be used in real time")]
    NoRealTime,
    /// The target lost its configuration within a trial.
    #[error("the controller was restarted in the middle of a trial")]
    Restarted,
    /// The target answered with a sequence number that was not sent.
    #[error("the controller answered with a sequence number that the bench has not sent")]
    WrongSequence,
    /// The target refused its configuration.
    #[error("the controller refused its configuration: {}", match .0 {
        Rejection::Value => "a value is outside its range",
        Rejection::Law => "it does not have this law",
    })]
    ConfigurationRejected(Rejection),
    /// The target's processor trapped, and its firmware reported it.
    #[error(
        "the controller trapped: code {}, pc {:#010x}, lr {:#010x}, cfsr {:#010x}, address {:#010x}",
        .0.code, .0.pc, .0.lr, .0.cfsr, .0.address
    )]
    Trapped(FaultReport),
}
