//! Defines the identity of a controller without capabilities.

use platebench_wire::Identity;

pub const IDENTITY: Identity = Identity {
    version: [0, 1, 0],
    capabilities: 0,
    laws: 0b111,
    build: [0; 8],
    chip: 0,
    unique: [0; 12],
    name: *b"test-kit\0\0\0\0\0\0\0\0",
};
