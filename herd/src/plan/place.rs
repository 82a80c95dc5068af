//! Where blocks lie: neighbours in space on the same node.

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

/// Nodes in an order of their own for each name: rendezvous hashing (Thaler and Ravishankar 1998), so that scenes spread over nodes.
pub fn ranked(name: &[u8], nodes: u32) -> Vec<u32> {
    let weight = |node: &u32| *blake3::Hasher::new().update(&node.to_le_bytes()).update(name).finalize().as_bytes();
    let mut order: Vec<u32> = (0..nodes).collect();
    order.sort_by_cached_key(weight);
    order
}

/// As [`holders`], but the first `homes` of the ranked nodes hold the first copies of all, so that as many workers beside them read
/// nothing from afar. The other copies lie on the other nodes, also in connected pieces, as long as none of these holds more than a home;
/// else each goes where least lies.
pub fn gathered(sizes: &[u64], ranked: &[u32], homes: u32, replicas: u32) -> Vec<Vec<u32>> {
    let nodes = ranked.len() as u32;
    let homes = homes.clamp(1, nodes.max(1));
    let more = replicas.clamp(1, nodes.max(1)) - 1;
    let mut load = vec![0u64; nodes as usize];
    let mut on = holders(sizes, homes, 1);
    // along each home's piece, all pieces side by side: what is dealt in this order fills no node before its time
    let mut order: Vec<(u64, u32, usize)> = Vec::with_capacity(sizes.len());
    for (i, &size) in sizes.iter().enumerate() {
        order.push((load[on[i][0] as usize], on[i][0], i));
        load[on[i][0] as usize] += size;
    }
    let others = nodes - homes;
    if more > 0 && others >= more * homes {
        for (on, piece) in on.iter_mut().zip(holders(sizes, others, more)) {
            on.extend(piece.into_iter().map(|p| homes + p));
        }
    } else {
        order.sort_unstable();
        for (_, _, i) in order {
            for _ in 0..more {
                let free = (0..nodes).filter(|n| !on[i].contains(n));
                let Some(least) = free.min_by_key(|&n| (load[n as usize], std::cmp::Reverse(n))) else { break };
                load[least as usize] += sizes[i];
                on[i].push(least);
            }
        }
    }
    on.iter_mut().flatten().for_each(|n| *n = ranked[*n as usize]);
    on
}

/// The window of at most `memory` bytes with most rays, and how many; of equals the first; none without rays. `before`: bytes of all splits before each
/// one, and of all; `with`: the splits that have rays, ascending.
pub fn fullest(
    before: &[u64],
    memory: u64,
    with: &[u32],
    rays: impl Fn(u32) -> u64,
) -> Option<(u64, std::ops::Range<u32>)> {
    let mut best: Option<(u64, std::ops::Range<u32>)> = None;
    // the window that ends at `end` begins at `first`; the first of those with rays in it is `with[inside]`
    let (mut first, mut inside, mut sum) = (0u32, 0, 0u64);
    for &end in with {
        sum += rays(end);
        while before[end as usize + 1] - before[first as usize] > memory {
            if with[inside] == first {
                sum -= rays(first);
                inside += 1;
            }
            first += 1;
        }
        if sum > best.as_ref().map_or(0, |b| b.0) {
            best = Some((sum, first..end + 1));
        }
    }
    best
}
