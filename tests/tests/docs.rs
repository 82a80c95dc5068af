//! What documents point to is there, and each alert is written about.

use std::fs;
use std::path::{Path, PathBuf};

fn top() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace holds this package").to_path_buf()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Targets of `[text](target)` that are no addresses.
fn links(text: &str) -> Vec<String> {
    let targets = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let files = targets.filter(|t| !t.contains("://") && !t.starts_with('#') && !t.contains(' '));
    files.map(|t| t.split('#').next().unwrap_or_default().to_owned()).collect()
}

#[test]
fn links_between_documents_lead_somewhere() {
    let top = top();
    let mut documents = vec![top.join("README.md"), top.join("CONTRIBUTING.md"), top.join("charts/rayherd/README.md")];
    for entry in fs::read_dir(top.join("docs")).expect("docs/") {
        documents.extend(Some(entry.expect("readable").path()).filter(|p| p.extension().is_some_and(|e| e == "md")));
    }
    assert_eq!(links("[a](b/c.md#d) ![e](f.png) [g](https://h) [i](#j)"), ["b/c.md", "f.png"]);
    let mut count = 0;
    for document in &documents {
        for link in links(&read(document)) {
            let target = document.parent().expect("a folder").join(&link);
            assert!(target.exists(), "{} points to {link}, which is not there", document.display());
            count += 1;
        }
    }
    assert!(count > 10, "{count} links: has the form changed?");
    // whoever reads the README finds every document
    let readme = links(&read(&top.join("README.md")));
    for document in documents.iter().filter(|d| d.parent().is_some_and(|p| p.ends_with("docs"))) {
        let path = document.strip_prefix(&top).expect("below the top").to_string_lossy().into_owned();
        assert!(readme.contains(&path), "the README does not name {path}");
    }
}

#[test]
fn each_alert_says_what_to_do() {
    let top = top();
    let rules = read(&top.join("charts/rayherd/monitoring/rules.yaml"));
    let alerts: Vec<&str> = rules.lines().filter_map(|l| l.trim().strip_prefix("- alert: ")).collect();
    assert!(alerts.len() >= 6, "{alerts:?}");
    let document = read(&top.join("docs/operations.md"));
    let sections: Vec<&str> = document.split("\n### ").skip(1).collect();
    for alert in &alerts {
        let found = sections.iter().find(|s| s.lines().next() == Some(alert));
        let text = found.unwrap_or_else(|| panic!("docs/operations.md has no heading {alert}"));
        assert!(text.len() > alert.len() + 80, "{alert}: too little");
    }
    for section in sections.iter().filter_map(|s| s.lines().next()).filter(|s| s.starts_with("Rayherd")) {
        assert!(alerts.contains(&section), "there is no alert {section}");
    }
}

/// Sources that a document names, as `file.rs` or `file.rs: test`.
fn named_tests(text: &str) -> Vec<(String, Option<String>)> {
    let spans = text.split('`').skip(1).step_by(2).filter(|s| !s.contains([' ', '\n']) || s.contains(".rs: "));
    let files = spans.filter_map(|s| match s.split_once(": ") {
        Some((file, test)) => Some((file, Some(test.to_owned()))),
        None => s.ends_with(".rs").then_some((s, None)),
    });
    files.map(|(file, test)| (file.to_owned(), test)).collect()
}

#[test]
fn each_test_that_the_numbers_stand_on_is_there() {
    assert_eq!(
        named_tests("`a/b.rs: c_d`, `x::y`, `e.rs`\n`--f g`"),
        [("a/b.rs".to_owned(), Some("c_d".to_owned())), ("e.rs".to_owned(), None)]
    );
    let top = top();
    let document = read(&top.join("docs/numerics.md"));
    let named = named_tests(&document);
    assert!(named.iter().filter(|(_, test)| test.is_some()).count() > 25, "{named:?}: has the form changed?");
    for (file, test) in named {
        let text = read(&top.join(&file));
        if let Some(test) = test {
            let at = text.find(&format!("fn {test}("));
            let at = at.unwrap_or_else(|| panic!("{file} has no {test}, which docs/numerics.md names"));
            // its attribute stands right before it, or before it in a macro
            assert!(text[..at].trim_end().ends_with("#[test]"), "{test} of {file} is no test");
        }
    }
    // every row of the first table ends with one at least
    let first = document.split("\n## ").next().unwrap_or_default();
    for row in first.lines().filter(|l| l.starts_with("| ") && !l.starts_with("| where")) {
        let last = row.trim_end_matches(" |").rsplit(" | ").next().unwrap_or_default();
        assert!(named_tests(last).iter().any(|(_, test)| test.is_some()), "no test in {row}");
    }
}
