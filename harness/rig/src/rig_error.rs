//! Defines why a session with a controller cannot continue.

use crate::link::LinkError;
use crate::rejected_bytes::RejectedBytes;
use crate::rejected_frame::RejectedFrame;
use platebench_wire::{FaultReport, Rejection};
use std::time::Duration;

/// Why a session cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    #[error(transparent)]
    Link(#[from] LinkError),
    #[error(
        "no {expected} from the controller; is it running, and does it speak version {} of the protocol?",
        platebench_wire::VERSION
    )]
    NoAnswer { expected: &'static str },
    #[error(
        "no identity from the controller within {} s{rejected}; is it running, is the baud rate right, and does it \
         speak version {} of the protocol?",
        waited.as_secs(), platebench_wire::VERSION
    )]
    NoIdentity { waited: Duration, rejected: RejectedBytes },
    #[error("cancelled while the bench waited for the identity of the controller")]
    Cancelled,
    #[error("no {expected} from the controller: {frame}")]
    RejectedAnswer { expected: &'static str, frame: RejectedFrame },
    #[error("this rig cannot be used in real time; use --clock lockstep")]
    NoRealTime,
    #[error("the controller was restarted in the middle of a trial")]
    Restarted,
    #[error(
        "another client uses the line: the controller answered a hello or a configuration that this bench did not \
         send; let one client at a time use the server's port"
    )]
    OtherClient,
    #[error("the controller answered with a sequence number that the bench has not sent")]
    WrongSequence,
    #[error("the controller refused its configuration: {}", match .0 {
        Rejection::Value => "a value is outside the range that the controller accepts",
        Rejection::Law => "it does not have this law; one with a law of its own must accept the numbers 0 to 8",
    })]
    ConfigurationRejected(Rejection),
    #[error(
        "the controller trapped: code {}, pc {:#010x}, lr {:#010x}, cfsr {:#010x}, address {:#010x}",
        .0.code, .0.pc, .0.lr, .0.cfsr, .0.address
    )]
    Trapped(FaultReport),
    #[error("the built-in scripts of the protocol check are invalid: {0}")]
    InvalidScripts(String),
}

impl RigError {
    /// The error without instants and callers: equal for the same fault at the same place.
    pub fn cause(&self) -> String {
        match self {
            Self::Link(LinkError::Target(error)) => error.cause(),
            other => other.to_string(),
        }
    }
}
