//! Uploading a scene with its files: each under the hash of all of them, sent once, gone on with where it broke off.

use std::fs;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rayherd_herd::store::check_key;
use rayherd_scene::inspect::size;

use crate::fault::Mistake;
use crate::log::bars;
use crate::progress::duration;
use crate::store::Store;

/// Most files that are uploaded for one scene: more are a folder that was meant otherwise.
const MOST_FILES: usize = 100_000;
/// Between two looks at how much was sent.
const LOOK: Duration = Duration::from_millis(250);
/// Between two lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// Uploads a scene with what lies beside it; its key.
pub fn upload(store: &Store, source: &Path) -> anyhow::Result<String> {
    let is_folder =
        fs::metadata(source).map_err(|e| Mistake(format!("cannot read {}: {e}", source.display())))?.is_dir();
    let folder = if is_folder { source } else { source.parent().unwrap_or(Path::new("")) };
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let files = files_below(folder)?;
    // the name is made of all names and contents: two scenes never share one, and the same scene is there already
    let mut hasher = blake3::Hasher::new();
    for (key, path) in &files {
        let mut file = blake3::Hasher::new();
        let read = fs::File::open(path).and_then(|f| file.update_reader(f).map(drop));
        read.with_context(|| format!("cannot read {}", path.display()))?;
        hasher.update(key.as_bytes()).update(&[0]).update(file.finalize().as_bytes());
    }
    let own = source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_else(|| "scene".into());
    let prefix = format!("scenes/{}-{}", name_of(&own), &hasher.finalize().to_hex()[..16]);
    let there: Vec<(String, u64)> = store.wait(store.blocks.list(&format!("{prefix}/")))?;
    let mut missing = Vec::new();
    for (key, path) in &files {
        let key = format!("{prefix}/{key}");
        check_key(&key).map_err(|e| Mistake(format!("{}: {e}: rename it", path.display())))?;
        let length = fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?.len();
        // whole objects only: a file that was cut off is none, and the store goes on with it
        if !there.contains(&(key.clone(), length)) {
            missing.push((key, path, length));
        }
    }
    let total = missing.iter().map(|(.., length)| length).sum();
    let mut transfer = Transfer::begin(store, total);
    let mut whole = 0;
    for (key, path, length) in &missing {
        transfer.put(key, path, (whole, *length)).with_context(|| {
            format!("cannot upload {}: what was sent stays, the same command goes on", path.display())
        })?;
        whole += length;
    }
    transfer.finish();
    eprintln!("{} of {} files uploaded, {}", missing.len(), files.len(), size(total));
    let key = if is_folder { prefix } else { format!("{prefix}/{own}") };
    eprintln!("the scene is {key}");
    Ok(key)
}

/// A name that Kubernetes takes, like that of a file.
pub fn name_of(stem: &str) -> String {
    let lower = stem.to_ascii_lowercase();
    let plain: String = lower.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    let name: String = plain.trim_matches('-').chars().take(50).collect();
    if name.is_empty() { "scene".into() } else { name.trim_end_matches('-').into() }
}

/// All files below a folder but hidden ones, by key relative to it, ascending.
fn files_below(folder: &Path) -> anyhow::Result<Vec<(String, PathBuf)>> {
    let mut found = Vec::new();
    let mut folders = vec![(String::new(), folder.to_owned())];
    while let Some((prefix, folder)) = folders.pop() {
        let read = |e| anyhow::Error::new(e).context(format!("cannot read {}", folder.display()));
        for entry in fs::read_dir(&folder).map_err(read)? {
            let entry = entry.map_err(read)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with('.') {
                continue;
            }
            let (key, path) = (format!("{prefix}{name}"), entry.path());
            if fs::metadata(&path).map_err(read)?.is_dir() {
                folders.push((format!("{key}/"), path));
            } else {
                found.push((key, path));
            }
            if found.len() > MOST_FILES {
                let told = "has more than 100000 files: put the scene into a folder of its own";
                return Err(Mistake(format!("{} {told}", folder.display())).into());
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Files on their way, and what is shown of them.
struct Transfer<'a> {
    store: &'a Store,
    total: u64,
    begun: Instant,
    last_line: Instant,
    bar: Option<ProgressBar>,
}

impl<'a> Transfer<'a> {
    fn begin(store: &'a Store, total: u64) -> Self {
        let now = Instant::now();
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("uploading {wide_bar:.cyan/blue} {percent:>3} %  {msg}");
            let bar = ProgressBar::with_draw_target(Some(total.max(1)), ProgressDrawTarget::hidden());
            if let Ok(style) = style {
                bar.set_style(style);
            }
            bars().add(bar)
        });
        Transfer { store, total, begun: now, last_line: now, bar }
    }

    /// Puts a file of so many bytes, after so many of others.
    fn put(&mut self, key: &str, path: &Path, (whole, length): (u64, u64)) -> anyhow::Result<()> {
        let base = self.store.sent.load(Ordering::Relaxed);
        self.store.wait(async {
            let mut put = pin!(self.store.blocks.put_file(key, path));
            loop {
                match tokio::time::timeout(LOOK, &mut put).await {
                    Ok(done) => return done,
                    // parts are counted again when the file is tried again: it has no more than it has
                    Err(_) => self.show(whole + (self.store.sent.load(Ordering::Relaxed) - base).min(length)),
                }
            }
        })?;
        Ok(())
    }

    fn show(&mut self, sent: u64) {
        let text = said(sent, self.total, self.begun.elapsed());
        if let Some(bar) = &self.bar {
            bar.set_position(sent);
            bar.set_message(text);
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            eprintln!("{:>3} %  {text}", 100 * sent / self.total.max(1));
        }
    }

    fn finish(self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
            bars().remove(bar);
        }
    }
}

/// How much, how fast, how long it will take.
fn said(sent: u64, total: u64, since: Duration) -> String {
    let seconds = since.as_secs_f64();
    let rate = if seconds > 0.0 { sent as f64 / seconds } else { 0.0 };
    let mut text = format!("{} of {}  {}/s", size(sent), size(total), size(rate as u64));
    if sent > 0 && rate > 0.0 {
        text += &format!("  {} left", duration((total - sent.min(total)) as f64 / rate));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::S3Options;

    #[test]
    fn a_job_is_named_after_its_file() {
        for (stem, name) in [("Cornell Box", "cornell-box"), ("a.b_c", "a-b-c"), ("--", "scene"), ("x", "x")] {
            assert_eq!(name_of(stem), name);
        }
    }

    #[test]
    fn progress_says_how_much_how_fast_and_how_long() {
        assert_eq!(said(0, 4 << 30, Duration::ZERO), "0 B of 4.0 GiB  0 B/s");
        assert_eq!(said(1 << 30, 4 << 30, Duration::from_secs(64)), "1.0 GiB of 4.0 GiB  16.0 MiB/s  3 min 12 s left");
        assert_eq!(said(10, 10, Duration::from_secs(1)), "10 B of 10 B  10 B/s  0 s left");
    }

    #[test]
    fn a_scene_is_uploaded_once_with_what_lies_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene");
        fs::create_dir_all(scene.join("textures")).unwrap();
        for (name, body) in [("room.xml", "<scene/>"), ("textures/a.png", "png"), (".hidden", "x")] {
            fs::write(scene.join(name), body).unwrap();
        }
        let place = folder.path().join("store");
        let store = Store::open(place.to_str().unwrap(), &S3Options::default()).unwrap();
        let list = || store.wait(store.blocks.list("scenes/")).unwrap();
        let key = upload(&store, &scene.join("room.xml")).unwrap();
        assert!(key.starts_with("scenes/room-xml-") && key.ends_with("/room.xml"), "{key}");
        let first = list();
        assert_eq!(first.len(), 2, "{first:?}");
        assert_eq!(upload(&store, &scene.join("room.xml")).unwrap(), key);
        // cut off: the rest is sent
        store.wait(store.blocks.delete(std::slice::from_ref(&key))).unwrap();
        assert_eq!(upload(&store, &scene.join("room.xml")).unwrap(), key);
        assert_eq!(list(), first);
        fs::write(scene.join("textures/a.png"), "other").unwrap();
        assert_ne!(upload(&store, &scene.join("room.xml")).unwrap(), key, "another content has another name");
        let all = upload(&store, &scene).unwrap();
        assert!(all.starts_with("scenes/scene-") && !all.ends_with(".xml"));
        fs::write(scene.join("with space.ply"), "x").unwrap();
        assert!(upload(&store, &scene).unwrap_err().to_string().contains("rename it"));
    }
}
