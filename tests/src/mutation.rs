//! Loops over damaged input: seeded, short by default, as long as wanted, each round replayable.
//!
//! `RAYHERD_FUZZ_SECONDS=N` makes every loop N seconds long, from a seed that differs from run to run. A round that fails prints its
//! seed; `RAYHERD_FUZZ_SEED=S` runs that round alone.

use std::ops::Range;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// From a seed.
    pub fn new(seed: u64) -> Self {
        Random(seed)
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `n`; 0 when `n` is 0.
    pub fn below(&mut self, n: usize) -> usize {
        (self.bits() % n.max(1) as u64) as usize
    }

    /// A piece of something of this length, of up to 64, perhaps none.
    pub fn range(&mut self, length: usize) -> Range<usize> {
        let at = self.below(length + 1);
        at..at + self.below((length - at).min(64) + 1)
    }
}

/// Runs `round` with the numbers of one seed after another: `least` times, or as the environment says (see the module). How many rounds
/// there were, so that the caller can say what share of them must have done what; `None` when one alone was replayed.
pub fn rounds(what: &str, least: u64, mut round: impl FnMut(&mut Random)) -> Option<u64> {
    let number = |name: &str| {
        let text = std::env::var(name).ok()?;
        Some(text.parse::<f64>().unwrap_or_else(|_| panic!("{name} is {text:?}: give a number")))
    };
    let mut one = |seed: u64| {
        let _replay = Replay { what, seed };
        round(&mut Random::new(seed));
    };
    if let Ok(text) = std::env::var("RAYHERD_FUZZ_SEED") {
        one(text.parse().unwrap_or_else(|_| panic!("RAYHERD_FUZZ_SEED is {text:?}: give a seed that was printed")));
        return None;
    }
    let Some(seconds) = number("RAYHERD_FUZZ_SECONDS") else {
        (1..=least).for_each(one);
        return Some(least);
    };
    let first = SystemTime::now().duration_since(UNIX_EPOCH).map_or(1, |d| d.as_nanos() as u64);
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    let mut n = 0;
    // a share of very few rounds would say nothing
    while n < 100 || Instant::now() < end {
        one(first.wrapping_add(n));
        n += 1;
    }
    println!("{what}: {n} rounds");
    Some(n)
}

/// Says on a panic how to see it again.
struct Replay<'a> {
    what: &'a str,
    seed: u64,
}

impl Drop for Replay<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("replay with RAYHERD_FUZZ_SEED={} on {}", self.seed, self.what);
        }
    }
}

/// One to four changes of bytes: a bit, a byte, a number at an extreme, a piece taken out, doubled or exchanged, a cut. Mostly one:
/// several seldom get past the first check.
pub fn bytes(valid: &[u8], random: &mut Random) -> Vec<u8> {
    let mut out = valid.to_vec();
    for _ in 0..1 + random.below(2) * random.below(4) {
        if out.is_empty() {
            break;
        }
        let at = random.below(out.len());
        let end = (at + 1 + random.below(8)).min(out.len());
        match random.below(9) {
            0 | 1 => out[at] ^= 1 << random.below(8),
            2 => out[at] = random.bits() as u8,
            3 => out[at..end].fill(0xff),
            4 => out[at..end].fill(0),
            5 => drop(out.drain(at..end)),
            6 => {
                let piece = out[at..end].to_vec();
                out.splice(at..at, piece);
            }
            7 => {
                let from = random.below(out.len() - (end - at) + 1);
                out.copy_within(from..from + (end - at), at);
            }
            _ => out.truncate(at),
        }
    }
    out
}

/// Numbers that parsers stumble over, then other words.
const WORDS: &[&str] = &[
    "-1",
    "0",
    "1",
    "255",
    "256",
    "65536",
    "2147483648",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "-9223372036854775808",
    "1e999",
    "1e39",
    "nan",
    "-inf",
    "1e-320",
    "0.0000001",
    "/",
    "//",
    "\\",
    "$",
    "$x",
    "#",
    "\0",
    "\n",
    "\r\n",
    " ",
    "\"",
    "<",
    ">",
    "{",
    "}",
    "[",
    "]",
    ",",
    ":",
    "null",
    "true",
];
/// So many of them are numbers.
const NUMBERS: usize = 17;

/// One or two changes of a text, whose own words and `more` ones are used.
pub fn text(valid: &[u8], more: &[&str], random: &mut Random) -> Vec<u8> {
    let mut out = valid.to_vec();
    // mostly one change: two seldom get past the first check
    for _ in 0..1 + random.below(5) / 4 {
        let range = random.range(out.len());
        match random.below(11) {
            0 => out.truncate(range.start),
            1 => drop(out.drain(range)),
            2 => {
                let copy = out[range].to_vec();
                let at = random.below(out.len() + 1);
                out.splice(at..at, copy);
            }
            3 | 4 => {
                if let Some(byte) = out.get_mut(range.start) {
                    *byte ^= 1 << random.below(8);
                }
            }
            5 => {
                if let Some(byte) = out.get_mut(range.start) {
                    *byte = random.bits() as u8;
                }
            }
            // a number becomes another
            6 => {
                let digits = |b: &u8| b.is_ascii_digit() || *b == b'.' || *b == b'-';
                let start = range.start + out[range.start..].iter().take_while(|b| !digits(b)).count();
                let end = start + out[start..].iter().take_while(|b| digits(b)).count();
                out.splice(start..end, WORDS[random.below(NUMBERS)].bytes());
            }
            // a word becomes another of the same file
            7..=9 => {
                let from = word(&out, random.below(out.len() + 1));
                let new = out[from].to_vec();
                let to = word(&out, range.start);
                out.splice(to, new);
            }
            _ => {
                let i = random.below(WORDS.len() + more.len());
                let new = WORDS.get(i).unwrap_or_else(|| &more[i - WORDS.len()]);
                let at = range.start;
                out.splice(at..at, new.bytes());
            }
        }
    }
    out
}

/// The word that begins at or after a place.
fn word(bytes: &[u8], at: usize) -> Range<usize> {
    let part = |b: &u8| b.is_ascii_alphanumeric() || b"._-+#$".contains(b);
    let start = at + bytes[at..].iter().take_while(|b| !part(b)).count();
    start..start + bytes[start..].iter().take_while(|b| part(b)).count()
}

/// Most memory that this process held so far, KiB, where the system tells.
pub fn peak_memory() -> Option<u64> {
    peak_memory_of("self")
}

/// The same of a process that runs, by its number.
pub fn peak_memory_of(process: impl std::fmt::Display) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().trim_end_matches("kB").trim().parse().ok()
}
