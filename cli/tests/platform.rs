//! The platform's mathematics stays out of pictures: glibc, musl and their versions round transcendental functions differently.
//!
//! Functions whose result IEEE 754 or the C standard leaves no choice about (floor, fma, sqrt, fmod, ..) may be called.
#![cfg(target_os = "linux")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Names of libm's functions that round as they please, without the `f` of single precision.
const FREE: [&str; 33] = [
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sincos", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh",
    "exp", "exp2", "exp10", "expm1", "log", "log2", "log10", "log1p", "pow", "cbrt", "hypot", "erf", "erfc", "lgamma",
    "tgamma", "gamma", "j0", "j1", "lgamma_r",
];

/// What the binary calls all the same, and why no picture depends on it.
const ALLOWED: [(&str, &str); 4] = [
    (
        "pow",
        "tokio's histograms, the S3 client's back-off and the progress bar's average: how long to wait, what to show",
    ),
    ("powf", "exr's decoder of DWA, which is refused before it is called"),
    ("logf", "the same"),
    ("cosf", "the same"),
];

fn is_free(name: &str) -> bool {
    FREE.iter().any(|f| name == *f || name.strip_suffix('f') == Some(f))
}

fn number<const N: usize>(bytes: &[u8], at: usize) -> u64 {
    bytes[at..at + N].iter().rev().fold(0, |n, &b| n << 8 | u64::from(b))
}

/// Names that a 64-bit little-endian ELF file uses and does not define, by its symbol tables (System V ABI, chapter 4).
fn undefined(elf: &[u8]) -> BTreeSet<String> {
    assert!(elf.starts_with(b"\x7fELF\x02\x01"), "no ELF file of 64 bits");
    let sections = number::<8>(elf, 0x28) as usize;
    let (size, count) = (number::<2>(elf, 0x3a) as usize, number::<2>(elf, 0x3c) as usize);
    // beyond 65,279 sections the number is the first one's size
    let count = if count == 0 && sections > 0 { number::<8>(elf, sections + 0x20) as usize } else { count };
    let header = |i: usize| sections + i * size;
    let body = |i: usize| {
        let at = number::<8>(elf, header(i) + 0x18) as usize;
        &elf[at..at + number::<8>(elf, header(i) + 0x20) as usize]
    };
    let mut names = BTreeSet::new();
    for i in 0..count {
        // SHT_SYMTAB, SHT_DYNSYM
        if ![2, 11].contains(&number::<4>(elf, header(i) + 4)) {
            continue;
        }
        let strings = body(number::<4>(elf, header(i) + 0x28) as usize);
        // 24 bytes each; of section 0: not here
        for symbol in body(i).chunks_exact(24).filter(|s| number::<2>(s, 6) == 0) {
            let name = strings[number::<4>(symbol, 0) as usize..].split(|&b| b == 0).next().unwrap_or_default();
            // without the version of a dynamic symbol
            let name = String::from_utf8_lossy(name).split('@').next().unwrap_or_default().to_owned();
            names.insert(name);
        }
    }
    names.remove("");
    names
}

/// The same of the objects in a library of Rust's; none of those that are no machine code yet (with link-time optimisation).
fn undefined_in_library(archive: &[u8]) -> BTreeSet<String> {
    assert!(archive.starts_with(b"!<arch>\n"), "no archive");
    let (mut at, mut names) = (8, BTreeSet::new());
    while at + 60 <= archive.len() {
        let size: usize = std::str::from_utf8(&archive[at + 48..at + 58]).unwrap().trim().parse().unwrap();
        let member = &archive[at + 60..at + 60 + size];
        if member.starts_with(b"\x7fELF") {
            names.extend(undefined(member));
        }
        at += 60 + size + size % 2;
    }
    names
}

fn binary() -> PathBuf {
    PathBuf::from(env!("CARGO_BIN_EXE_rayherd"))
}

/// The library of a crate that was built last beside the binary.
fn library(name: &str) -> PathBuf {
    let deps = binary().parent().expect("in a folder").join("deps");
    let begin = format!("lib{name}-");
    let entries = fs::read_dir(&deps).unwrap_or_else(|e| panic!("{}: {e}", deps.display()));
    let all = entries.map(|e| e.expect("a readable folder").path()).filter(|p: &PathBuf| {
        let file = p.file_name().unwrap_or_default().to_string_lossy().into_owned();
        file.starts_with(&begin) && file.ends_with(".rlib")
    });
    let newest = all.max_by_key(|p| fs::metadata(p).and_then(|m| m.modified()).expect("a file with a time"));
    newest.unwrap_or_else(|| panic!("no lib{name} in {}", deps.display()))
}

fn of_library(path: &Path) -> BTreeSet<String> {
    undefined_in_library(&fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
}

#[test]
fn the_binary_imports_no_mathematics_but_what_is_named() {
    let names = undefined(&fs::read(binary()).expect("the binary"));
    assert!(names.contains("malloc") || names.contains("memcpy"), "it imports nothing: is it read rightly? {names:?}");
    let free: Vec<&String> = names.iter().filter(|n| is_free(n)).collect();
    println!("imported: {free:?}");
    let unknown: Vec<&&String> = free.iter().filter(|n| !ALLOWED.iter().any(|a| a.0 == n.as_str())).collect();
    assert!(unknown.is_empty(), "{unknown:?} of the platform's libm: call the crate `libm`");
    for (name, why) in ALLOWED {
        println!("{name} may be: {why}");
    }
}

#[test]
fn our_crates_call_no_mathematics_of_the_platform() {
    // a crate that is known to: that it is seen there shows that it would be seen in ours
    let other = of_library(&library("glam"));
    if other.is_empty() && !cfg!(debug_assertions) {
        println!("libraries hold no machine code with link-time optimisation: only the binary was looked at");
        return;
    }
    assert!(other.iter().any(|n| is_free(n)), "glam's rotations call the platform's sines: {other:?}");
    for name in ["rayherd_render", "rayherd_scene", "rayherd_api", "rayherd_herd"] {
        let names = of_library(&library(name));
        assert!(!names.is_empty(), "{name} uses nothing: is it read rightly?");
        let free: Vec<&String> = names.iter().filter(|n| is_free(n)).collect();
        assert!(free.is_empty(), "{name} calls {free:?} of the platform: call the crate `libm`");
    }
}
