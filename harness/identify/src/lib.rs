//! Plate parameters from recorded responses (section IV of the paper).
