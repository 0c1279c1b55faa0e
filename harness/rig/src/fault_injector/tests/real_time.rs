use super::*;

fn real_time_trial_with(faults: &[WireFault]) -> Fixture {
    let mut fixture = trial_with(faults);
    fixture.session.link_mut().start_real_time(Instant::now(), 10.0);
    fixture
}

fn receive_deadline() -> Instant {
    Instant::now() + Duration::from_secs(20)
}

#[test]
fn delivers_when_due_in_real_time() {
    let from = WireFault { kind: WireFaultKind::Delay(ms(200)), direction: Direction::FromController, ..ALWAYS };
    for delay in [from, WireFault { direction: Direction::ToController, ..from }] {
        let mut fixture = real_time_trial_with(&[delay]);
        let line = fixture.session.link_mut().real_time_line().unwrap();
        let sent = Instant::now();
        line.send(&frame(3, 1.0)).unwrap();
        let mut bytes = Vec::new();
        assert_eq!(line.receive(sent, &mut bytes).unwrap(), None);
        let at = line.receive(receive_deadline(), &mut bytes).unwrap().unwrap();
        // 200 ms of the trial are 20 ms of wall time.
        assert!(at >= sent + ms(20) && Instant::now() >= at, "{:?}", at - sent);
        assert!(matches!(decode_first_packet(&bytes), Some(Packet { sequence: 3, message: Message::Command(_) })));
        assert_eq!(fixture.delivered().len(), 1);
    }
}

#[test]
fn waits_no_longer_than_the_deadline_in_real_time() {
    let mut fixture = real_time_trial_with(&[WireFault { direction: Direction::FromController, ..ALWAYS }]);
    let line = fixture.session.link_mut().real_time_line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let mut bytes = Vec::new();
    assert_eq!(line.receive(Instant::now() + ms(5), &mut bytes).unwrap(), None);
    assert_eq!((bytes.len(), fixture.counts()), (0, vec![("drop", 1)]));
}

#[test]
fn passes_other_messages_at_once_in_real_time() {
    let mut fixture = real_time_trial_with(&[ALWAYS]);
    let line = fixture.session.link_mut().real_time_line().unwrap();
    line.send(&frame(3, 1.0)).unwrap();
    let safe = Packet { sequence: 9, message: Message::Safe }.encode();
    line.send(safe.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    while decode_first_packet(&bytes).is_none() {
        assert!(line.receive(receive_deadline(), &mut bytes).unwrap().is_some());
    }
    let Message::Command(command) = decode_first_packet(&bytes).unwrap().message else { panic!("{bytes:?}") };
    assert_eq!((command.state, command.drive_vpp), (ControllerState::Safe, 0.0));
    let delivered: Vec<u8> = fixture.delivered().into_iter().flat_map(|(_, bytes)| bytes).collect();
    assert_eq!(delivered, [&[DELIMITER], safe.as_bytes()].concat());
}
