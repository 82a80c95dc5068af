//! The invariants of docs/architecture.md that a program can check: what is absent, and where.

use std::fs;
use std::path::{Path, PathBuf};

fn top() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace holds this package").to_path_buf()
}

/// Every Rust file below a folder of the workspace, by its path from the top.
fn sources(folder: &str) -> Vec<(String, String)> {
    let top = top();
    let mut found = Vec::new();
    let mut folders = vec![top.join(folder)];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.expect("a readable folder").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                let text = fs::read_to_string(&path).expect("readable source");
                let relative = path.strip_prefix(&top).expect("below the top").to_string_lossy().to_string();
                found.push((relative, text));
            }
        }
    }
    assert!(!found.is_empty(), "no sources in {folder}: has it moved?");
    found
}

/// The paths that a use declaration imports, groups written out: `std::{fs, io::Read}` is `std::fs` and `std::io::Read`.
fn written_out(tree: &str) -> Vec<String> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else { return vec![tree.to_owned()] };
    let (prefix, group) = (&tree[..open], tree[open + 1..].trim_end().trim_end_matches('}'));
    // the braces that were trimmed too much belong to the last item: they are put back by counting
    let missing = group.matches('{').count().saturating_sub(group.matches('}').count());
    let group = format!("{group}{}", "}".repeat(missing));
    let (mut depth, mut item, mut items) = (0, String::new(), Vec::new());
    for c in group.chars() {
        match c {
            ',' if depth == 0 => items.push(std::mem::take(&mut item)),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                item.push(c);
            }
        }
    }
    items.push(item);
    let items = items.iter().map(|i| i.trim()).filter(|i| !i.is_empty());
    items.flat_map(written_out).map(|path| format!("{prefix}{path}")).collect()
}

/// Every use declaration's paths, with the line where it begins.
fn imports(text: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    let mut begun: Option<(usize, String)> = None;
    for (number, line) in text.lines().enumerate() {
        let line = line.split("//").next().unwrap_or_default().trim();
        let words =
            line.trim_start_matches("pub").trim_start_matches("(crate)").trim_start_matches("(super)").trim_start();
        match &mut begun {
            Some((_, tree)) => tree.push_str(line),
            None if words.starts_with("use ") => begun = Some((number, words["use ".len()..].to_owned())),
            None => {}
        }
        if let Some((number, tree)) = begun.take_if(|(_, tree)| tree.contains(';')) {
            let tree = tree.split(';').next().unwrap_or_default();
            found.extend(written_out(tree).into_iter().map(|path| (number, path)));
        }
    }
    found
}

#[test]
fn a_group_of_imports_hides_nothing() {
    let text =
        "pub(super) use std::{\n    fs, // files\n    io::{self, Read},\n};\nuse a::b;\nlet x = std::env::args();";
    let paths: Vec<String> = imports(text).into_iter().map(|(line, path)| format!("{line} {path}")).collect();
    assert_eq!(paths, ["0 std::fs", "0 std::io::self", "0 std::io::Read", "4 a::b"]);
    let files = [("x.rs".to_owned(), text.to_owned())];
    assert_eq!(
        offending(&files, &["std::fs", "std::io", "std::env"]),
        ["x.rs:1: std::fs", "x.rs:1: std::io", "x.rs:6: std::env"]
    );
}

/// Lines of code (no comment lines) that contain one of the words, and imports that do when their groups are written out.
fn offending(files: &[(String, String)], words: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    for (path, text) in files {
        let hit = |code: &str| words.iter().find(|w| code.contains(**w));
        let mut lines: Vec<(usize, &str)> =
            imports(text).iter().filter_map(|(number, import)| Some((*number, *hit(import)?))).collect();
        lines.dedup();
        for (number, line) in text.lines().enumerate() {
            if !line.trim_start().starts_with("//")
                && let Some(word) = hit(line)
            {
                lines.push((number, word));
            }
        }
        lines.sort_unstable();
        lines.dedup();
        found.extend(lines.into_iter().map(|(number, word)| format!("{path}:{}: {word}", number + 1)));
    }
    found
}

/// Names of the workspace's crates that a crate depends on outside its tests.
fn dependencies(folder: &str) -> Vec<String> {
    let text = fs::read_to_string(top().join(folder).join("Cargo.toml")).expect("a manifest");
    let mut inside = false;
    let mut found = Vec::new();
    for line in text.lines() {
        if line.starts_with('[') {
            inside = line.trim() == "[dependencies]";
        } else if inside && let Some(name) = line.strip_prefix("rayherd-") {
            found.push(name.split(['.', ' ', '=']).next().unwrap_or_default().to_string());
        }
    }
    found
}

#[test]
fn dependencies_point_down() {
    let allowed: [(&str, &[&str]); 7] = [
        ("render", &[]),
        ("scene", &["render"]),
        ("api", &[]),
        ("herd", &["render", "scene", "api"]),
        ("cli", &["render", "scene", "api", "herd"]),
        ("worker", &["herd"]),
        ("operator", &["scene", "api", "herd"]),
    ];
    for (folder, may) in allowed {
        for name in dependencies(folder) {
            assert!(may.contains(&name.as_str()), "{folder} must not depend on {name}");
        }
    }
}

#[test]
fn render_is_pure() {
    let words = [
        "std::fs",
        "std::io",
        "std::net",
        "std::thread",
        "std::time",
        "std::env",
        "Instant::now",
        "SystemTime",
        "async fn",
        ".await",
        "tokio",
        "rayon",
        "println!",
        "eprintln!",
    ];
    // render's tests may read the environment (how long to run) and start threads; the system's error, when it has no memory
    // to give, is no I/O
    let files: Vec<_> = sources("render/src")
        .into_iter()
        .filter(|(p, _)| !p.ends_with("tests.rs") && !p.ends_with("testing.rs") && !p.contains("/tests/"))
        .map(|(p, text)| (p, text.split("#[cfg(test)]\nmod ").next().unwrap_or_default().replace("std::io::Error", "")))
        .collect();
    assert_eq!(offending(&files, &words), Vec::<String>::new());
}

/// What decides what runs where and what counts is a function of what it is told.
#[test]
fn planner_ledger_and_waves_are_pure() {
    let words = [
        "std::fs",
        "std::io",
        "std::net",
        "std::thread",
        "std::time",
        "std::env",
        "Instant",
        "SystemTime",
        "async fn",
        ".await",
        "tokio",
        "tracing",
        "rand::",
        "HashMap",
        "HashSet",
        "crate::store",
        "crate::local",
        "crate::remote",
        "crate::driver",
        "crate::job",
        "ObjectStore",
        "BlockStore",
    ];
    let pure = |p: &str| {
        let module = |m: &str| p == format!("herd/src/{m}.rs") || p.starts_with(&format!("herd/src/{m}/"));
        ["plan", "ledger", "wave"].into_iter().any(module)
    };
    let files: Vec<_> = sources("herd/src").into_iter().filter(|(p, _)| pure(p) && !p.ends_with("tests.rs")).collect();
    assert!(files.len() >= 10, "have they moved?");
    assert_eq!(offending(&files, &words), Vec::<String>::new());
}

#[test]
fn scene_knows_no_async_and_no_s3() {
    assert_eq!(offending(&sources("scene/src"), &["async fn", ".await", "tokio", "aws_"]), Vec::<String>::new());
}

#[test]
fn only_the_s3_store_knows_s3() {
    let mut files = sources("herd/src");
    files.extend(sources("cli/src"));
    files.extend(sources("api/src"));
    files.extend(sources("worker/src"));
    files.extend(sources("operator/src"));
    files.retain(|(p, _)| p != "herd/src/store/s3.rs" && !p.starts_with("herd/src/store/s3/"));
    assert_eq!(offending(&files, &["aws_sdk", "aws_smithy", "aws_config"]), Vec::<String>::new());
}

#[test]
fn only_the_operator_and_one_module_of_the_command_line_know_kubernetes() {
    let mut files = Vec::new();
    for folder in ["render/src", "scene/src", "api/src", "herd/src", "cli/src", "worker/src"] {
        files.extend(sources(folder));
    }
    // the resource's definition: types without a client
    files.retain(|(p, _)| p != "api/src/resource.rs" && p != "api/src/job.rs" && p != "cli/src/cluster.rs");
    assert_eq!(offending(&files, &["kube::", "k8s_openapi"]), Vec::<String>::new());
    assert_eq!(offending(&sources("api/src"), &["kube::Client", "kube::Api", "kube_client"]), Vec::<String>::new());
}

/// Rays and film go from worker to store to worker.
#[test]
fn the_operator_reads_no_rays_and_no_film() {
    let words = ["ray_group", "FilmPart", "open_film", "codec", "attempt::run", "Adder"];
    let files: Vec<_> = sources("operator/src")
        .into_iter()
        .chain(sources("herd/src/remote"))
        .chain(sources("herd/src/driver"))
        .collect();
    let of_workers = |p: &str| {
        ["remote/station/", "remote/tests.rs", "remote/tests/", "remote/bands.rs"].iter().any(|own| p.contains(own))
    };
    let files: Vec<_> = files.into_iter().filter(|(p, _)| !of_workers(p)).collect();
    assert_eq!(offending(&files, &words), Vec::<String>::new());
}

#[test]
fn unsafe_stays_in_named_modules() {
    let named = [
        "render/src/bvh/arena.rs",
        "render/src/bvh/trace/",
        "render/src/bvh/wide.rs",
        "render/src/light/wide.rs",
        "render/src/path/wide.rs",
        "render/src/memory.rs",
        "render/src/wide.rs",
        "scene/src/import/spill.rs",
        // counts what is allocated
        "tests/tests/allocations.rs",
    ];
    let mut files = Vec::new();
    for folder in
        ["render/src", "scene/src", "api/src", "herd/src", "cli/src", "worker/src", "operator/src", "tests/tests"]
    {
        files.extend(sources(folder));
    }
    // the words are in this file
    files.retain(|(p, _)| p != "tests/tests/architecture.rs");
    files.retain(|(p, _)| !named.iter().any(|n| p.starts_with(n)));
    assert_eq!(offending(&files, &["unsafe ", "unsafe{", "allow(unsafe_code)"]), Vec::<String>::new());
}
