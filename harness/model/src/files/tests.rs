use super::*;
use rstest::rstest;
use rustix::fs::{CWD, mknodat};
use std::io::Read as _;
use std::os::unix::fs::{FileTypeExt as _, symlink};
use std::sync::Barrier;
use tempfile::TempDir;

/// Folder with the opened folder `run`, and beside it `private/keep`, which no test may change.
struct Place {
    root: TempDir,
    run: OutputFolder,
}

impl Place {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join("private")).unwrap();
        fs::write(root.path().join("private/keep"), "kept").unwrap();
        let run = OutputFolder::create(&root.path().join("run")).unwrap();
        Self { root, run }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.at(name)).unwrap()
    }

    fn names(&self, folder: &str) -> Vec<OsString> {
        let mut names: Vec<_> =
            fs::read_dir(self.at(folder)).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    }

    fn assert_untouched(&self) {
        assert_eq!(self.read("private/keep"), "kept");
        assert_eq!(self.names("private"), ["keep"]);
    }
}

fn make_fifo(path: &Path) {
    mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
}

#[test]
fn replaces_the_content_and_leaves_no_other_file() {
    let place = Place::new();
    for content in ["first", "2"] {
        place.run.write("a/b.json", content).unwrap();
        assert_eq!(place.read("run/a/b.json"), content);
    }
    assert_eq!(place.names("run/a"), ["b.json"]);
}

#[test]
fn keeps_the_old_content_until_the_commit() {
    let place = Place::new();
    place.run.write("a", "old").unwrap();
    let mut file = place.run.create_file("a").unwrap();
    file.write_all(b"new").unwrap();
    assert_eq!(place.read("run/a"), "old");
    drop(file);
    assert_eq!(place.read("run/a"), "old");
    assert_eq!(place.names("run"), ["a"]);
}

#[rstest]
#[case::of_a_file("../private/keep")]
#[case::that_is_dangling("../private/new")]
#[case::of_a_device("/dev/full")]
fn replaces_a_link_in_the_place_of_a_file(#[case] target: &str) {
    let place = Place::new();
    symlink(target, place.at("run/a")).unwrap();
    place.run.write("a", "new").unwrap();
    assert!(fs::symlink_metadata(place.at("run/a")).unwrap().is_file());
    assert_eq!(place.read("run/a"), "new");
    place.assert_untouched();
}

#[test]
fn replaces_a_pipe_without_waiting_for_a_reader() {
    let place = Place::new();
    make_fifo(&place.at("run/a"));
    place.run.write("a", "new").unwrap();
    assert_eq!(place.read("run/a"), "new");
}

#[rstest]
#[case::of_a_folder("../private")]
#[case::of_a_folder_below("real")]
#[case::that_is_dangling("../private/new")]
fn refuses_a_link_in_the_place_of_a_folder(#[case] target: &str) {
    let place = Place::new();
    place.run.create_folder("real").unwrap();
    place.run.create_folder("a").unwrap();
    symlink(Path::new("..").join(target), place.at("run/a/link")).unwrap();
    let link = place.at("run/a/link").display().to_string();
    let run = &place.run;
    let mut source = File::open(place.at("private/keep")).unwrap();
    for result in [
        run.write("a/link/x", ""),
        run.write_new("a/link/x", ""),
        run.append("a/link/x").map(drop),
        run.copy(&mut source, "a/link/x"),
        run.create_folder("a/link/x").map(drop),
        run.create_folder("a/link").map(drop),
        run.remove_file("a/link/keep"),
        run.remove_folder("a/link"),
        run.rename("a/link/keep", "b"),
        run.rename("real", "a/link/x"),
    ] {
        assert_eq!(result.unwrap_err().to_string(), format!("{link}: {LINK}"));
    }
    assert_eq!(place.names("run/real"), [""; 0]);
    place.assert_untouched();
}

#[rstest]
#[case::of_a_file("../private/keep")]
#[case::that_is_dangling("../private/new")]
fn appends_to_and_creates_no_file_behind_a_link(#[case] target: &str) {
    let place = Place::new();
    symlink(target, place.at("run/a")).unwrap();
    let error = place.run.append("a").unwrap_err().to_string();
    assert_eq!(error, format!("{}: {LINK}", place.at("run/a").display()));
    assert_eq!(place.run.write_new("a", "").unwrap_err().source.kind(), ErrorKind::AlreadyExists);
    place.assert_untouched();
}

#[test]
fn a_folder_that_is_swapped_for_a_link_is_not_followed() {
    let place = Place::new();
    let inner = place.run.create_folder("inner").unwrap();
    let file = place.run.create_file("inner/keep").unwrap();
    fs::rename(place.at("run/inner"), place.at("run/moved")).unwrap();
    symlink("../private", place.at("run/inner")).unwrap();
    file.commit().unwrap();
    inner.write("b", "new").unwrap();
    assert_eq!(place.names("run/moved"), ["b", "keep"]);
    place.assert_untouched();
}

#[test]
fn appends_to_a_regular_file_only() {
    let place = Place::new();
    for _ in 0..2 {
        place.run.append("a").unwrap().write_all(b"x").unwrap();
    }
    assert_eq!(place.read("run/a"), "xx");
    make_fifo(&place.at("run/fifo"));
    let _reader = File::options().read(true).write(true).open(place.at("run/fifo")).unwrap();
    let error = place.run.append("fifo").unwrap_err();
    assert_eq!(error.source.to_string(), "it is a pipe or a device, expected a file");
}

#[rstest]
#[case("../private/keep")]
#[case("/etc/hostname")]
#[case("a/../../private/keep")]
#[case("..")]
#[case("")]
fn refuses_a_path_outside_the_folder(#[case] path: &str) {
    let place = Place::new();
    assert_eq!(place.run.write(path, "").unwrap_err().source.kind(), ErrorKind::InvalidInput);
    assert_eq!(place.run.remove_folder(path).unwrap_err().source.kind(), ErrorKind::InvalidInput);
    place.assert_untouched();
}

#[test]
fn names_a_file_instead_of_a_folder() {
    let place = Place::new();
    fs::write(place.at("file"), "").unwrap();
    let error = OutputFolder::create(&place.at("file")).unwrap_err();
    assert_eq!(error.source.to_string(), NO_FOLDER);
    place.run.write("file", "").unwrap();
    let error = place.run.write("file/a", "").unwrap_err();
    assert_eq!(error.to_string(), format!("{}: {NO_FOLDER}", place.at("run/file").display()));
}

#[test]
fn a_link_to_the_opened_folder_keeps_its_meaning() {
    let place = Place::new();
    symlink("run", place.at("latest")).unwrap();
    OutputFolder::create(&place.at("latest")).unwrap().write("a", "new").unwrap();
    assert_eq!(place.read("run/a"), "new");
}

#[test]
fn writes_only_a_new_file() {
    let place = Place::new();
    place.run.write_new("a", "first").unwrap();
    assert_eq!(place.run.write_new("a", "second").unwrap_err().source.kind(), ErrorKind::AlreadyExists);
    let mut file = place.run.create_file("a").unwrap();
    file.write_all(b"third").unwrap();
    assert_eq!(file.commit_new().unwrap_err().source.kind(), ErrorKind::AlreadyExists);
    assert_eq!(place.read("run/a"), "first");
    place.run.create_file("b").unwrap().commit_new().unwrap();
    assert_eq!(place.names("run"), ["a", "b"]);
}

#[test]
fn removes_a_folder_but_not_what_its_links_name() {
    let place = Place::new();
    place.run.write("a/b/c", "").unwrap();
    symlink("../../../private", place.at("run/a/b/folder")).unwrap();
    symlink("../../private/keep", place.at("run/a/file")).unwrap();
    place.run.remove_folder("a").unwrap();
    assert_eq!(place.names("run"), [""; 0]);
    place.assert_untouched();
}

#[test]
fn removes_unfinished_files_only() {
    let place = Place::new();
    let unfinished = place.run.create_file("x").unwrap();
    let name = unfinished.place.as_ref().unwrap().temporary.clone();
    assert_eq!(place.names("run"), [name]);
    for name in ["a.json", "b.part", ".0123456789abcde.part", ".0123456789abcdeg.part"] {
        place.run.write(name, "").unwrap();
    }
    make_fifo(&place.at("run/fifo"));
    symlink("../private", place.at("run/link")).unwrap();
    place.run.remove_temporary_files().unwrap();
    place.run.sync_tree().unwrap();
    let kept = [".0123456789abcde.part", ".0123456789abcdeg.part", "a.json", "b.part", "fifo", "link"];
    assert_eq!(place.names("run"), kept);
}

#[test]
fn accepts_the_longest_name() {
    let place = Place::new();
    place.run.write("x".repeat(255), "").unwrap();
    assert!(place.run.write("x".repeat(256), "").is_err());
    assert_eq!(place.names("run").len(), 1);
}

#[test]
fn simultaneous_writers_of_one_file_all_succeed() {
    const WRITERS: usize = 24;
    let place = Place::new();
    let contents: Vec<String> = (0..WRITERS).map(|index| format!("{index} ").repeat(10_000)).collect();
    let start = Barrier::new(WRITERS);
    std::thread::scope(|scope| {
        for content in &contents {
            let (start, run) = (&start, &place.run);
            scope.spawn(move || {
                start.wait();
                run.write("folder/page", content).unwrap();
            });
        }
    });
    assert!(contents.contains(&place.read("run/folder/page")));
    assert_eq!(place.names("run/folder"), ["page"]);
}

#[test]
fn a_named_output_keeps_a_link_and_replaces_its_target() {
    let place = Place::new();
    symlink("run/a.json", place.at("link")).unwrap();
    for content in ["new", "replaced"] {
        write_named_by_user(&place.at("link"), content).unwrap();
        assert!(place.at("link").is_symlink(), "{content}");
        assert_eq!(place.read("run/a.json"), content);
    }
    assert_eq!(place.names("run"), ["a.json"]);
}

#[test]
fn a_named_output_can_be_a_pipe_or_a_device() {
    let place = Place::new();
    make_fifo(&place.at("fifo"));
    // Linux opens a FIFO for reading and writing without waiting for the other end.
    let mut reader = File::options().read(true).write(true).open(place.at("fifo")).unwrap();
    write_named_by_user(&place.at("fifo"), "content").unwrap();
    assert!(fs::symlink_metadata(place.at("fifo")).unwrap().file_type().is_fifo());
    let mut content = [0; 7];
    reader.read_exact(&mut content).unwrap();
    assert_eq!(&content, b"content");
    write_named_by_user(Path::new("/dev/null"), "content").unwrap();
    assert_eq!(write_named_by_user(Path::new("/dev/full"), "x").unwrap_err().source.kind(), ErrorKind::StorageFull);
}

#[test]
fn a_named_output_in_a_missing_folder_is_an_error() {
    let place = Place::new();
    let path = place.at("missing/a");
    let error = write_named_by_user(&path, "").unwrap_err();
    assert_eq!((error.path, error.source.kind()), (path, ErrorKind::NotFound));
    assert!(write_named_by_user(&place.at("run"), "").is_err());
}

#[test]
fn reads_a_file_up_to_its_limit() {
    let place = Place::new();
    let path = place.at("private/keep");
    assert_eq!(read_text_file(&path, 4).unwrap(), "kept");
    assert_eq!(read_regular_file(&path, 3).unwrap_err().to_string(), "4 bytes, expected at most 3");
}

#[test]
fn rejects_irregular_files() {
    let place = Place::new();
    make_fifo(&place.at("fifo"));
    symlink("/dev/zero", place.at("link")).unwrap();
    for path in [place.at("fifo"), place.at("link"), place.at("run"), "/dev/zero".into()] {
        let error = open_regular_file(&path, 1_000).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidInput, "{}", path.display());
    }
}
