//! `rayherd compare`: how much two pictures differ.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use rayherd_herd::job::Image;
use serde::Serialize;

use super::print;
use crate::fault::Mistake;
use crate::output::exr_file::{self, Channels};
use crate::output::{distinct, png_file, replace};

/// Compare two EXR pictures, B being the reference; prints JSON
///
///   identical       the same pixels, to the bit
///   file_identical  the same bytes of the files, headers included
///   max_abs_diff    largest |A - B| over all pixels and channels
///   rmse            root of the mean of (A - B)^2
///   relmse          mean of (A - B)^2 / (B^2 + 0.01)
///   mean_ratio      mean of A / mean of B, per channel
///   channels        the same by channel
/// Layers beside the picture (AOVs) count for identical and channels; the other
/// figures, and what is accepted, are those of the picture. Layers that only one
/// of the two has are listed in only_in_a and only_in_b.
/// A figure that is not finite is null.
#[derive(Args)]
#[command(
    verbatim_doc_comment,
    after_help = "Exit status: 0 when the pixels are identical or every --max-... that was given holds, \
    1 when not, 2 when the pictures can't be compared.\n\n\
    Examples:\n  rayherd compare a.exr b.exr\n  rayherd compare noisy.exr reference.exr --max-relmse 0.01 --diff d.png"
)]
pub struct Arguments {
    /// The picture in question
    a: PathBuf,
    /// The reference
    b: PathBuf,
    /// Write a picture of |A - B| / (|B| + 0.1) per channel, white where a pixel differs by that much or more
    #[arg(long, value_name = "PNG")]
    diff: Option<PathBuf>,
    /// Accept a largest absolute difference up to this
    #[arg(long, value_name = "X", value_parser = tolerance, allow_negative_numbers = true)]
    max_abs_diff: Option<f64>,
    /// Accept a root mean squared error up to this
    #[arg(long, value_name = "X", value_parser = tolerance, allow_negative_numbers = true)]
    max_rmse: Option<f64>,
    /// Accept a relMSE up to this
    #[arg(long, value_name = "X", value_parser = tolerance, allow_negative_numbers = true)]
    max_relmse: Option<f64>,
    /// Accept means that differ by up to this share in every channel
    #[arg(long, value_name = "X", value_parser = tolerance, allow_negative_numbers = true)]
    max_mean_error: Option<f64>,
}

/// Compares, prints, and answers by the exit status.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    if let Some(path) = &arguments.diff {
        distinct::check_inputs(std::slice::from_ref(path), [arguments.a.as_path(), arguments.b.as_path()])?;
    }
    let (a, b) = (exr_file::read(&arguments.a)?, exr_file::read(&arguments.b)?);
    check_same_shape(&a, &b, arguments)?;
    let comparison = Comparison::of(&a, &b, same_bytes(&arguments.a, &arguments.b)?);
    if let Some(path) = &arguments.diff {
        let png = difference(&a, &b)?;
        replace::replace(path, &png).map_err(|e| Mistake(format!("cannot write {}: {e}", path.display())))?;
    }
    print(&format!("{}\n", serde_json::to_string_pretty(&comparison)?))?;
    let accepted = comparison.identical || within(arguments, &comparison);
    Ok(if accepted { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v >= 0.0 => Ok(v),
        _ => Err("give a number of 0 or more".into()),
    }
}

#[derive(Serialize)]
struct Comparison {
    identical: bool,
    file_identical: bool,
    width: usize,
    height: usize,
    #[serde(flatten)]
    measures: Measures,
    mean_ratio: BTreeMap<String, f64>,
    channels: BTreeMap<String, Measures>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    only_in_a: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    only_in_b: Vec<String>,
}

#[derive(Clone, Copy, Serialize)]
struct Measures {
    max_abs_diff: f64,
    rmse: f64,
    relmse: f64,
}

impl Comparison {
    /// Both have the same sizes, and the same channels but for layers beside the picture.
    fn of(a: &Channels, b: &Channels, file_identical: bool) -> Self {
        let only = |one: &Channels, other: &Channels| {
            one.values.keys().filter(|name| !other.values.contains_key(*name)).cloned().collect::<Vec<_>>()
        };
        let (only_in_a, only_in_b) = (only(a, b), only(b, a));
        let pairs = || a.values.iter().filter_map(|(name, a)| Some((name, a, b.values.get(name)?)));
        let picture = picture_channels(a);
        let of_picture = || pairs().filter(|(name, ..)| picture.contains(name));
        let same = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits());
        Comparison {
            identical: only_in_a.is_empty() && only_in_b.is_empty() && pairs().all(|(_, a, b)| same(a, b)),
            file_identical,
            width: a.width,
            height: a.height,
            measures: Measures::of(of_picture().flat_map(|(_, a, b)| a.iter().zip(b))),
            mean_ratio: of_picture().map(|(name, a, b)| (name.clone(), mean(a) / mean(b))).collect(),
            channels: pairs().map(|(name, a, b)| (name.clone(), Measures::of(a.iter().zip(b)))).collect(),
            only_in_a,
            only_in_b,
        }
    }
}

/// Channels that are the picture: those of no layer, or all where each is of one.
fn picture_channels(channels: &Channels) -> Vec<&String> {
    let plain: Vec<&String> = channels.values.keys().filter(|name| !name.contains('.')).collect();
    if plain.is_empty() { channels.values.keys().collect() } else { plain }
}

impl Measures {
    /// Of values in question beside their references. Infinities or NaNs that are the same count as equal.
    fn of<'a>(pairs: impl Iterator<Item = (&'a f32, &'a f32)>) -> Self {
        let (mut largest, mut squares, mut relative, mut n) = (0f64, 0f64, 0f64, 0u64);
        for (&a, &b) in pairs {
            n += 1;
            if a.to_bits() == b.to_bits() {
                continue;
            }
            let (difference, b) = (f64::from(a) - f64::from(b), f64::from(b));
            // unlike f64::max, this keeps a NaN
            largest = if largest.is_nan() || difference.abs() <= largest { largest } else { difference.abs() };
            squares += difference * difference;
            relative += difference * difference / (b * b + 0.01);
        }
        Measures { max_abs_diff: largest, rmse: (squares / n as f64).sqrt(), relmse: relative / n as f64 }
    }
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64
}

/// Whether at least one tolerance was given and all that were hold. A NaN is within none.
fn within(arguments: &Arguments, comparison: &Comparison) -> bool {
    let mean_error = comparison.mean_ratio.values().map(|r| (r - 1.0).abs());
    let mean_error = mean_error.fold(0.0, |most: f64, e| if most.is_nan() || e <= most { most } else { e });
    let limits = [
        (arguments.max_abs_diff, comparison.measures.max_abs_diff),
        (arguments.max_rmse, comparison.measures.rmse),
        (arguments.max_relmse, comparison.measures.relmse),
        (arguments.max_mean_error, mean_error),
    ];
    let mut given = limits.into_iter().filter_map(|(limit, value)| limit.map(|limit| value <= limit)).peekable();
    given.peek().is_some() && given.all(|holds| holds)
}

fn check_same_shape(a: &Channels, b: &Channels, arguments: &Arguments) -> Result<(), Mistake> {
    let (a_path, b_path) = (arguments.a.display(), arguments.b.display());
    if (a.width, a.height) != (b.width, b.height) {
        let sizes = format!("{a_path} is {}x{} but {b_path} is {}x{}", a.width, a.height, b.width, b.height);
        return Err(Mistake(format!("{sizes}: render both at one size")));
    }
    if picture_channels(a) != picture_channels(b) {
        let names = |c: &Channels| c.values.keys().cloned().collect::<Vec<_>>().join(", ");
        let channels = format!("{a_path} has channels {} but {b_path} has {}", names(a), names(b));
        return Err(Mistake(format!("{channels}: only pictures with the same channels can be compared")));
    }
    Ok(())
}

fn same_bytes(a: &Path, b: &Path) -> anyhow::Result<bool> {
    let open = |p: &Path| File::open(p).map(BufReader::new).with_context(|| format!("cannot read {}", p.display()));
    let (mut one, mut other) = (open(a)?, open(b)?);
    loop {
        let failed = || format!("cannot read {} and {} again", a.display(), b.display());
        let (x, y) = (one.fill_buf().with_context(failed)?, other.fill_buf().with_context(failed)?);
        let n = x.len().min(y.len());
        if n == 0 || x[..n] != y[..n] {
            return Ok(x.is_empty() && y.is_empty());
        }
        one.consume(n);
        other.consume(n);
    }
}

/// Relative differences as grey levels of the sRGB curve; the first channels named R, G and B, or else one for all.
fn difference(a: &Channels, b: &Channels) -> anyhow::Result<Vec<u8>> {
    let channel = |name: &str| a.values.contains_key(name).then(|| name.to_owned());
    let first = || a.values.keys().next().cloned().context("a picture without channels");
    let names = match [channel("R"), channel("G"), channel("B")] {
        [Some(r), Some(g), Some(b)] => [r, g, b],
        _ => [first()?, first()?, first()?],
    };
    let value = |name: &String, i: usize| {
        let (a, b) = (f64::from(a.values[name][i]), f64::from(b.values[name][i]));
        ((a - b).abs() / (b.abs() + 0.1)) as f32
    };
    let pixels = (0..a.width * a.height).map(|i| std::array::from_fn(|c| value(&names[c], i))).collect();
    Ok(png_file::encode(&Image { width: a.width as u32, height: a.height as u32, pixels }, 0.0)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channels(values: &[f32]) -> Channels {
        Channels { width: values.len(), height: 1, values: BTreeMap::from([("Y".to_owned(), values.to_vec())]) }
    }

    #[test]
    fn measures_are_those_of_their_definitions() {
        let c = Comparison::of(&channels(&[1.0, 2.0, 4.0]), &channels(&[1.0, 3.0, 2.0]), false);
        assert!(!c.identical);
        assert_eq!(c.measures.max_abs_diff, 2.0);
        assert_eq!(c.measures.rmse, (5.0f64 / 3.0).sqrt());
        assert_eq!(c.measures.relmse, (1.0 / 9.01 + 4.0 / 4.01) / 3.0);
        assert_eq!(c.mean_ratio["Y"], 7.0 / 6.0);
        assert_eq!(c.channels["Y"].rmse, c.measures.rmse);

        let same = Comparison::of(&channels(&[f32::NAN, 1.0]), &channels(&[f32::NAN, 1.0]), true);
        assert!(same.identical && same.measures.rmse == 0.0 && same.measures.relmse == 0.0);
        // zero and minus zero are not the same pixel, though no measure tells them apart
        let zero = Comparison::of(&channels(&[0.0]), &channels(&[-0.0]), false);
        assert!(!zero.identical && zero.measures.max_abs_diff == 0.0);
    }

    #[test]
    fn a_nan_is_within_no_tolerance() {
        let arguments = |max_rmse, max_abs_diff| Arguments {
            a: "a".into(),
            b: "b".into(),
            diff: None,
            max_abs_diff,
            max_rmse,
            max_relmse: None,
            max_mean_error: None,
        };
        let c = Comparison::of(&channels(&[f32::NAN, 1.0]), &channels(&[1.0, 5.0]), false);
        assert!(c.measures.max_abs_diff.is_nan());
        assert!(!within(&arguments(Some(f64::INFINITY), None), &c));
        assert!(!within(&arguments(None, Some(f64::INFINITY)), &c));
        let c = Comparison::of(&channels(&[2.0]), &channels(&[1.0]), false);
        assert!(within(&arguments(Some(1.0), None), &c) && !within(&arguments(Some(1.0), Some(0.5)), &c));
        assert!(!within(&arguments(None, None), &c));
    }
}
