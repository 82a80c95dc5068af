//! `--no-skip`: what is done though the scene does not need it.

use clap::Args;
use rayherd_api::RenderJobSpec;
use rayherd_render::skip::{Skip, Skips};

use crate::options::set;

/// No path has so many rays: roulette never begins.
const NEVER: i32 = 65535;

/// What is not skipped.
#[derive(Args, Default)]
#[command(next_help_heading = "Skipping")]
pub struct SkipOptions {
    /// Do what the scene does not need, to see what leaving it out saves: cells, beaten, walk, splits, attributes, textures, shadows,
    /// lights, lobes, details, sky, merged, roulette, aovs, film, tiles, prepared, volume or all; repeatable. But for lights, roulette and
    /// tiles the image stays the same bytes
    #[arg(long, value_name = "NAME", value_parser = switched_off)]
    no_skip: Vec<Off>,
}

/// What one use of the flag switches off.
#[derive(Clone, Copy, Debug)]
enum Off {
    One(Skip),
    All,
}

fn switched_off(text: &str) -> Result<Off, String> {
    if text == "all" { Ok(Off::All) } else { text.parse().map(Off::One).map_err(|e| format!("{e}")) }
}

impl SkipOptions {
    /// What is skipped.
    pub fn skips(&self) -> Skips {
        self.no_skip.iter().fold(Skips::ALL, |skips, off| match off {
            Off::One(skip) => skips.without(*skip),
            Off::All => Skips::NONE,
        })
    }

    /// Roulette belongs to what defines the picture.
    pub fn apply(&self, spec: &mut RenderJobSpec) {
        set(&mut spec.sampling.rr_depth, (!self.skips().makes(Skip::Roulette)).then_some(NEVER));
    }
}

#[cfg(test)]
mod tests {
    use clap::{Args as _, Command};

    use super::*;

    #[test]
    fn help_names_every_skip() {
        let help = SkipOptions::augment_args(Command::new("x")).render_long_help().to_string();
        let help = help.split_whitespace().collect::<Vec<_>>().join(" ");
        for skip in Skip::ALL {
            assert!(
                [format!(" {},", skip.name()), format!(" {} or all;", skip.name())].iter().any(|n| help.contains(n))
            );
        }
    }

    #[test]
    fn flags_add_up() {
        let both = SkipOptions { no_skip: vec![Off::One(Skip::Cells), Off::One(Skip::Sky)] };
        assert_eq!(both.skips(), Skips::ALL.without(Skip::Cells).without(Skip::Sky));
        let all = SkipOptions { no_skip: vec![switched_off("all").unwrap()] };
        assert_eq!(all.skips(), Skips::NONE);
        assert!(switched_off("everything").unwrap_err().contains("volume or all"));
        let mut spec = RenderJobSpec::default();
        both.apply(&mut spec);
        assert_eq!(spec.sampling.rr_depth, None);
        all.apply(&mut spec);
        assert_eq!(spec.sampling.rr_depth, Some(NEVER));
    }
}
