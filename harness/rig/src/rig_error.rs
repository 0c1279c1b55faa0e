//! Defines why a session with a controller cannot continue.

use crate::link::LinkError;
use platebench_wire::{FaultReport, Rejection};

#[derive(Debug, thiserror::Error)]
pub enum RigError {
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error(
        "no {expected} from the controller; is it running, and does it speak version {} of the protocol?",
        platebench_wire::VERSION
    )]
    NoAnswer { expected: &'static str },
    #[error("this rig cannot be used in real time; use --clock lockstep")]
    NoRealTime,
    #[error("the controller was restarted in the middle of a trial")]
    Restarted,
    #[error("the controller answered with a sequence number that the bench has not sent")]
    WrongSequence,
    #[error("the controller refused its configuration: {}", match .0 {
        Rejection::Value => "a value is outside the range that the controller accepts",
        Rejection::Law => "it does not have this law",
    })]
    ConfigurationRejected(Rejection),
    #[error(
        "the controller trapped: code {}, pc {:#010x}, lr {:#010x}, cfsr {:#010x}, address {:#010x}",
        .0.code, .0.pc, .0.lr, .0.cfsr, .0.address
    )]
    Trapped(FaultReport),
}
