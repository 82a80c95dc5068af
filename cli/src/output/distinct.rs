//! Files that are written must be no files that are read, nor each other.

use std::path::{Path, PathBuf};

use crate::fault::Mistake;

/// Refuses two outputs that are one file.
pub fn check_outputs(outputs: &[PathBuf]) -> Result<(), Mistake> {
    let places: Vec<PathBuf> = outputs.iter().map(|p| place(p)).collect();
    match (1..places.len()).find(|&i| places[..i].contains(&places[i]) && is_file(&outputs[i])) {
        Some(i) => {
            Err(Mistake(format!("two results would be written to {}: give each its own file", outputs[i].display())))
        }
        None => Ok(()),
    }
}

/// Refuses an output that is one of the inputs, or lies in one that is a folder whose files are read.
pub fn check_inputs<'a>(outputs: &[PathBuf], inputs: impl IntoIterator<Item = &'a Path>) -> Result<(), Mistake> {
    let places: Vec<PathBuf> = outputs.iter().map(|p| place(p)).collect();
    for input in inputs {
        let read = place(input);
        if let Some(i) = places.iter().position(|p| *p == read && is_file(p)) {
            return Err(Mistake(format!(
                "{} would be written over, and the picture is made of it: choose another place for the result",
                outputs[i].display()
            )));
        }
    }
    Ok(())
}

/// A path in one form: that of the file it leads to, or of the folder where it would be made.
fn place(path: &Path) -> PathBuf {
    if let Ok(known) = std::fs::canonicalize(path) {
        return known;
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match (std::fs::canonicalize(folder), path.file_name()) {
        (Ok(folder), Some(name)) => folder.join(name),
        _ => path.to_owned(),
    }
}

/// What is no file (`/dev/null`, a pipe) takes any number of results.
fn is_file(path: &Path) -> bool {
    std::fs::metadata(path).map_or(true, |m| m.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_file_by_two_names_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("in")).unwrap();
        std::fs::write(at("a.png"), "").unwrap();
        assert!(check_outputs(&[at("a.exr"), at("a.png"), at("in/../a.json")]).is_ok());
        let refused = check_outputs(&[at("a.exr"), at("in/../a.exr")]).unwrap_err().to_string();
        assert!(refused.contains("a.exr") && refused.contains("its own file"), "{refused}");
        assert!(check_outputs(&["/dev/null".into(), "/dev/null".into()]).is_ok());
        assert!(check_inputs(&[at("a.exr")], [at("a.png").as_path()]).is_ok());
        let refused = check_inputs(&[at("b.exr"), at("in/../a.png")], [at("a.png").as_path()]).unwrap_err();
        assert!(refused.to_string().contains("would be written over"), "{refused}");
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("a.png"), at("link")).unwrap();
            assert!(check_inputs(&[at("link")], [at("a.png").as_path()]).is_err());
        }
    }
}
