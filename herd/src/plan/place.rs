//! Where blocks lie, and which windows of them nodes hold: neighbours in space on the same node.

/// Order of splits along a Morton curve through the middles of their boxes (in units of `box_size` from `lo`).
///
/// The result lists split numbers; equal places keep the order of their numbers.
pub fn order(boxes: &[([f32; 3], [f32; 3])]) -> Vec<u32> {
    let mut lo = [f32::INFINITY; 3];
    let mut hi = [f32::NEG_INFINITY; 3];
    let middles: Vec<[f32; 3]> = boxes.iter().map(|(a, b)| std::array::from_fn(|i| 0.5 * a[i] + 0.5 * b[i])).collect();
    for m in &middles {
        for i in 0..3 {
            lo[i] = lo[i].min(m[i]);
            hi[i] = hi[i].max(m[i]);
        }
    }
    let code = |m: &[f32; 3]| {
        let mut code = 0u64;
        for i in 0..3 {
            let extent = hi[i] - lo[i];
            let x = if extent > 0.0 { ((m[i] - lo[i]) / extent * 1023.0) as u64 } else { 0 };
            for bit in 0..10 {
                code |= (x >> bit & 1) << (3 * bit + i);
            }
        }
        code
    };
    let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
    order.sort_by_key(|&s| (code(&middles[s as usize]), s));
    order
}

/// Nodes that get a copy of each split (given by size, in order): the curve is cut into as many parts of equal bytes
/// as there are nodes, and node `n` holds the parts `n .. n + replicas`, one connected piece of space.
pub fn holders(sizes: &[u64], nodes: u32, replicas: u32) -> Vec<Vec<u32>> {
    let total: u64 = sizes.iter().sum::<u64>().max(1);
    let copies = replicas.clamp(1, nodes.max(1));
    let mut before = 0u64;
    sizes
        .iter()
        .map(|&size| {
            let middle = u128::from(before) + u128::from(size) / 2;
            before += size;
            let part = ((middle * u128::from(nodes)) / u128::from(total)).min(u128::from(nodes.max(1) - 1)) as u32;
            (0..copies).map(|k| (part + nodes - k) % nodes).collect()
        })
        .collect()
}

/// Windows of neighbouring splits that fit the nodes' memories, spread evenly over the curve (which is closed to a
/// ring), so that all nodes together hold as much of the scene as they can.
pub fn windows(sizes: &[u64], memory: &[u64]) -> Vec<Vec<u32>> {
    let total: u64 = sizes.iter().sum();
    let n = sizes.len();
    let starts = spread(sizes, memory);
    let fill = |start: usize, memory: u64| {
        let mut window = Vec::new();
        let mut left = memory;
        for k in 0..n {
            let s = (start + k) % n;
            if sizes[s] > left {
                break;
            }
            left -= sizes[s];
            window.push(s as u32);
        }
        window.sort_unstable();
        window
    };
    let spaced: Vec<Vec<u32>> = memory.iter().zip(&starts).map(|(&m, &start)| fill(start, m)).collect();
    if n == 0 || total == 0 || covers(n, &spaced) {
        return spaced;
    }
    // one after the other covers more when there is little to spare
    let mut at = 0;
    memory
        .iter()
        .map(|&m| {
            let window = fill(at, m);
            at = (at + window.len()) % n;
            window
        })
        .collect()
}

/// Start of each node's window: node `i` of `n` at the split that holds the point `i / n` of the bytes.
fn spread(sizes: &[u64], memory: &[u64]) -> Vec<usize> {
    let total: u128 = sizes.iter().map(|&s| u128::from(s)).sum();
    let n = memory.len().max(1) as u128;
    (0..memory.len() as u128)
        .map(|i| {
            let point = total * i / n;
            let mut before = 0u128;
            sizes
                .iter()
                .position(|&s| {
                    // the same rule as for holders: a split belongs to the part that its middle is in
                    let middle = before + u128::from(s) / 2;
                    before += u128::from(s);
                    middle >= point
                })
                .unwrap_or(0)
        })
        .collect()
}

/// Whether every split is in some window.
pub fn covers(splits: usize, windows: &[Vec<u32>]) -> bool {
    let mut seen = vec![false; splits];
    windows.iter().flatten().for_each(|&s| seen[s as usize] = true);
    seen.iter().all(|s| *s)
}

/// The window of at most `memory` bytes with most rays; of equals the first.
pub fn fullest(sizes: &[u64], memory: u64, rays: impl Fn(u32) -> u64) -> Vec<u32> {
    let mut best = (0u64, 0..0u32);
    let (mut first, mut bytes, mut sum) = (0u32, 0u64, 0u64);
    for end in 0..sizes.len() as u32 {
        bytes += sizes[end as usize];
        sum += rays(end);
        while bytes > memory {
            bytes -= sizes[first as usize];
            sum -= rays(first);
            first += 1;
        }
        if sum > best.0 {
            best = (sum, first..end + 1);
        }
    }
    best.1.collect()
}
