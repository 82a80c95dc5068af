//! Help and usage.

mod common;

use common::rayherd;

const COMMANDS: [&str; 11] =
    ["render", "check", "prepare", "inspect", "compare", "replay", "gc", "scene", "submit", "jobs", "logs"];

#[test]
fn every_command_has_help_with_an_example() {
    let folder = tempfile::tempdir().unwrap();
    let top = rayherd(folder.path(), &["--help"]);
    assert_eq!(top.code, 0);
    for command in COMMANDS {
        assert!(top.out.contains(&format!("\n  {command} ")), "{}", top.out);
        let help = rayherd(folder.path(), &[command, "--help"]);
        assert_eq!(help.code, 0);
        assert!(help.out.contains("Example") && help.out.contains(&format!("rayherd {command} ")), "{}", help.out);
        assert!(help.out.lines().all(|l| l.chars().count() <= 110), "{}", help.out);
    }
    // no command is without a line here
    let listed = top.out.lines().skip_while(|l| !l.starts_with("Commands:")).skip(1);
    let listed = listed.take_while(|l| !l.is_empty()).filter(|l| !l.starts_with("  help ")).count();
    assert_eq!(listed, COMMANDS.len(), "{}", top.out);
}

#[test]
fn usage_errors_exit_with_2() {
    let folder = tempfile::tempdir().unwrap();
    for arguments in [&[][..], &["frobnicate"], &["compare", "one.exr"], &["inspect", "--no-such-flag"]] {
        assert_eq!(rayherd(folder.path(), arguments).code, 2, "{arguments:?}");
    }
    assert_eq!(rayherd(folder.path(), &["--version"]).out.trim(), concat!("rayherd ", env!("CARGO_PKG_VERSION")));
}
