//! Runs the program in a terminal and reads its screen.

use crate::test_folder::{ChildGuard, PROGRAM, wait_until};
use platebench_test_kit::{command_with_default_signals, open_terminal};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::termios::{LocalModes, SpecialCodeIndex, Termios, Winsize, tcgetattr, tcsetwinsize};
use std::ffi::OsStr;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::num::NonZero;
use std::path::Path;
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::{self, JoinHandle};
use vt100::{Color, Parser};

/// Size of the terminal: columns, rows.
pub(crate) const SMALL: [u16; 2] = [80, 24];
pub(crate) const LARGE: [u16; 2] = [200, 50];

pub(crate) struct TestTerminal {
    pub(crate) child: ChildGuard,
    keys: Option<File>,
    line: Option<File>,
    initial_modes: Termios,
    screen: Arc<Mutex<Parser>>,
    closed: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl TestTerminal {
    pub(crate) fn start<A: AsRef<OsStr>>(
        folder: &Path,
        size: [u16; 2],
        arguments: impl IntoIterator<Item = A>,
        environment: &[(&str, &str)],
    ) -> Self {
        let (master, path) = open_terminal();
        let line = File::from(open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).unwrap());
        let before = tcgetattr(&line).unwrap();
        set_size(&master, size);
        let end = || Stdio::from(OpenOptions::new().read(true).write(true).open(&path).unwrap());
        // In a session of its own, the program gets Ctrl-C and hang-up of the terminal as signals.
        let mut command = command_with_default_signals("setsid");
        command.args(["--ctty", PROGRAM]).args(arguments).current_dir(folder);
        command.env_remove("PLATEBENCH_LOG").env_remove("NO_COLOR").env("TERM", "xterm-256color");
        command.envs(environment.iter().copied()).stdin(end()).stdout(end()).stderr(end());
        let child = ChildGuard(command.spawn().unwrap());
        let screen = Arc::new(Mutex::new(Parser::new(non_zero(size[1]), non_zero(size[0]), 0)));
        let closed = Arc::new(AtomicBool::new(false));
        let reader = {
            let (output, screen, closed) = (master.try_clone().unwrap(), Arc::clone(&screen), Arc::clone(&closed));
            thread::spawn(move || read_until_closed(output, &screen, &closed))
        };
        Self {
            child,
            keys: Some(master),
            line: Some(line),
            initial_modes: before,
            screen,
            closed,
            reader: Some(reader),
        }
    }

    fn screen(&self) -> MutexGuard<'_, Parser> {
        self.screen.lock().unwrap()
    }

    pub(crate) fn text(&self) -> String {
        self.screen().screen().contents()
    }

    pub(crate) fn is_alternate(&self) -> bool {
        self.screen().screen().alternate_screen()
    }

    pub(crate) fn has_colour(&self) -> bool {
        let parser = self.screen();
        let (rows, columns) = parser.screen().size();
        let mut cells = (0..rows.get()).flat_map(|row| (0..columns.get()).map(move |column| (row, column)));
        cells.any(|(row, column)| {
            let cell = parser.screen().cell(row, column);
            cell.is_some_and(|cell| cell.fgcolor() != Color::Default || cell.bgcolor() != Color::Default)
        })
    }

    #[track_caller]
    pub(crate) fn assert_text(&self, text: &str) {
        assert!(self.text().contains(text), "{text} is not in:\n{}", self.text());
    }

    #[track_caller]
    pub(crate) fn wait_for_view_text(&mut self, text: &str) {
        self.wait_for_text(text, true);
    }

    #[track_caller]
    pub(crate) fn wait_for_terminal_text(&mut self, text: &str) {
        self.wait_for_text(text, false);
    }

    #[track_caller]
    fn wait_for_text(&mut self, text: &str, in_view: bool) {
        wait_until(&format!("the screen never shows `{text}`"), || {
            assert!(!self.child.has_ended(), "the program ended before it showed `{text}`:\n{}", self.text());
            self.is_alternate() == in_view && self.text().contains(text)
        });
    }

    pub(crate) fn type_keys(&mut self, keys: &str) {
        self.keys.as_mut().unwrap().write_all(keys.as_bytes()).unwrap();
    }

    #[track_caller]
    pub(crate) fn answer(&mut self, prompt: &str, answer: &str) {
        self.wait_for_terminal_text(prompt);
        self.type_keys(answer);
    }

    pub(crate) fn resize(&mut self, size: [u16; 2]) {
        self.screen().screen_mut().set_size(non_zero(size[1]), non_zero(size[0]));
        set_size(self.keys.as_ref().unwrap(), size);
    }

    #[track_caller]
    pub(crate) fn wait_for_exit(&mut self, expected: &[i32]) {
        wait_until("the program does not end", || self.child.has_ended());
        let code = self.child.0.wait().unwrap().code();
        let after = tcgetattr(self.line.as_ref().unwrap()).unwrap();
        self.line = None;
        self.reader.take().unwrap().join().unwrap();
        assert!(code.is_some_and(|code| expected.contains(&code)), "{code:?}\n{}", self.text());
        let modes = |termios: &Termios| {
            let keys = [SpecialCodeIndex::VSUSP, SpecialCodeIndex::VQUIT, SpecialCodeIndex::VMIN];
            (termios.input_modes, termios.local_modes, keys.map(|key| termios.special_codes[key]))
        };
        assert!(self.initial_modes.local_modes.contains(LocalModes::ICANON | LocalModes::ECHO));
        assert_eq!(modes(&after), modes(&self.initial_modes));
        assert!(!self.is_alternate(), "{}", self.text());
        assert!(!self.screen().screen().hide_cursor());
    }

    pub(crate) fn close(mut self) -> ChildGuard {
        self.closed.store(true, Ordering::Relaxed);
        self.reader.take().unwrap().join().unwrap();
        (self.keys, self.line) = (None, None);
        self.child
    }
}

fn non_zero(count: u16) -> NonZero<u16> {
    NonZero::new(count).unwrap()
}

fn set_size(terminal: &File, [columns, rows]: [u16; 2]) {
    tcsetwinsize(terminal, Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
}

fn read_until_closed(mut output: File, screen: &Mutex<Parser>, closed: &AtomicBool) {
    let mut bytes = [0; 4096];
    let soon = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
    while !closed.load(Ordering::Relaxed) {
        if poll(&mut [PollFd::new(&output, PollFlags::IN)], Some(&soon)).unwrap() == 0 {
            continue;
        }
        let Ok(count @ 1..) = output.read(&mut bytes) else { return };
        screen.lock().unwrap().process(&bytes[..count]);
    }
}
