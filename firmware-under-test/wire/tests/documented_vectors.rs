//! Compares encoder and decoder with the test vectors of `docs/examples/test-vectors.txt`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use platebench_wire::{EncodedFrame, FrameReader, Packet};

const VECTORS: &str = include_str!("../../../docs/examples/test-vectors.txt");

fn bytes(line: &str) -> Vec<u8> {
    line.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

#[test]
fn every_vector_encodes_and_decodes() {
    let lines: Vec<_> = VECTORS.lines().collect();
    let vectors: Vec<_> = lines
        .windows(2)
        .filter_map(|pair| Some((bytes(pair[0].strip_prefix("body  ")?), bytes(pair[1].strip_prefix("frame ")?))))
        .collect();
    assert_eq!(vectors.len(), 15, "one for each kind, a second command and three more configurations");
    for (body, frame) in vectors {
        assert_eq!(EncodedFrame::new(&body).unwrap().as_bytes(), frame);
        let packet = Packet::decode(&body).unwrap();
        assert_eq!(packet.encode().as_bytes(), frame, "{packet:?}");
        let mut reader = FrameReader::new();
        let read: Vec<_> =
            frame.iter().filter_map(|&byte| reader.push(byte).map(|body| body.unwrap().to_vec())).collect();
        assert_eq!(read, [body]);
    }
}
