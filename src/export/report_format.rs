//! Numbers as people read them: a sensible unit, three or four digits, thousands set apart.

/// A dash, for numbers that do not exist.
const NONE: &str = "–";

/// A count, thousands set apart by narrow spaces that do not break.
pub(super) fn count(n: impl TryInto<u64>) -> String {
    let digits = n.try_into().unwrap_or(u64::MAX).to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

/// A number with so many decimals, or a dash.
pub(super) fn fixed(x: f64, decimals: usize) -> String {
    if x.is_finite() {
        let text = format!("{x:.decimals$}");
        // A zero has no sign.
        let is_zero = !text.contains(|c: char| ('1'..='9').contains(&c));
        if is_zero {
            text.replace('-', "")
        } else {
            text.replace('-', "−")
        }
    } else {
        NONE.into()
    }
}

/// A length in µm, mm, m or km.
pub(super) fn length(metres: f64) -> String {
    scaled(
        metres,
        &[(1e-6, "µm"), (1e-3, "mm"), (1.0, "m"), (1e3, "km")],
    )
}

/// An area in mm², cm² or m².
pub(super) fn area(square_metres: f64) -> String {
    if square_metres >= 0.1 {
        return scaled(square_metres, &[(1.0, "m²")]);
    }
    scaled(square_metres, &[(1e-6, "mm²"), (1e-4, "cm²")])
}

/// A time in µs, ms, s or min.
pub(super) fn duration(secs: f64) -> String {
    scaled(
        secs,
        &[(1e-6, "µs"), (1e-3, "ms"), (1.0, "s"), (60.0, "min")],
    )
}

/// An amount of memory in KiB, MiB or GiB.
pub(super) fn memory(bytes: u64) -> String {
    let unit = |power: i32| 1024f64.powi(power);
    scaled(
        bytes as f64,
        &[(unit(1), "KiB"), (unit(2), "MiB"), (unit(3), "GiB")],
    )
}

/// A share of one as per cent with two decimals.
pub(super) fn percent(share: f64) -> String {
    if share.is_finite() {
        format!("{} %", fixed(100.0 * share, 2))
    } else {
        NONE.into()
    }
}

/// The relative change from one number to another as per cent with its sign, or a dash.
pub(super) fn change(before: f64, after: f64) -> String {
    let share = after / before - 1.0;
    if !share.is_finite() {
        return NONE.into();
    }
    let sign = if share >= 0.0 { "+" } else { "" };
    format!("{sign}{} %", fixed(100.0 * share, 0))
}

/// A number of any size in few characters, for axes and energies: 250k, 1.2M, 0.05, 3e−6.
pub(super) fn compact(x: f64) -> String {
    let magnitude = x.abs();
    let text = match magnitude {
        0.0 => "0".into(),
        m if !m.is_finite() => NONE.into(),
        m if !(1e-3..1e12).contains(&m) => scientific(x),
        m if m >= 1e9 => significant(x / 1e9) + "G",
        m if m >= 1e6 => significant(x / 1e6) + "M",
        m if m >= 1e4 => significant(x / 1e3) + "k",
        _ => significant(x),
    };
    text.replace('-', "−")
}

/// Three digits and a power of ten.
fn scientific(x: f64) -> String {
    let text = format!("{x:.2e}");
    match text.split_once('e') {
        Some((digits, power)) => format!(
            "{}e{power}",
            digits.trim_end_matches('0').trim_end_matches('.')
        ),
        None => text,
    }
}

/// The largest unit that leaves at least one, with three digits.
fn scaled(x: f64, units: &[(f64, &str)]) -> String {
    if !x.is_finite() {
        return NONE.into();
    }
    let fits = |&&(size, _): &&(f64, &str)| x.abs() >= size;
    match units.iter().rev().find(fits).or(units.first()) {
        Some((size, unit)) => format!("{} {unit}", significant(x / size)),
        None => significant(x),
    }
}

/// About three digits, without zeros at the end.
fn significant(x: f64) -> String {
    let decimals = match x.abs() {
        m if m >= 99.95 => 0,
        m if m >= 9.995 => 1,
        m if m >= 0.9995 => 2,
        m if m >= 0.0995 => 3,
        _ => 4,
    };
    let text = format!("{x:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').into()
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!(count(1_234_567u64), "1\u{202f}234\u{202f}567");
        assert_eq!(count(0usize), "0");
        assert_eq!(
            (length(0.00132), length(12.34), length(0.0)),
            ("1.32 mm".into(), "12.3 m".into(), "0 µm".into())
        );
        assert_eq!(
            (area(0.0412), area(0.5)),
            ("412 cm²".into(), "0.5 m²".into())
        );
        assert_eq!(
            (duration(0.0042), duration(75.0)),
            ("4.2 ms".into(), "1.25 min".into())
        );
        assert_eq!(
            (fixed(-0.001, 2), fixed(-0.1, 1)),
            ("0.00".into(), "−0.1".into())
        );
        assert_eq!(memory(1_610_612_736), "1.5 GiB");
        assert_eq!(
            (percent(0.0412), percent(f64::NAN)),
            ("4.12 %".into(), "–".into())
        );
        assert_eq!(
            (change(4.0, 2.0), change(2.0, 3.0), change(0.0, 0.0)),
            ("−50 %".into(), "+50 %".into(), "–".into())
        );
        assert_eq!(
            (compact(250_000.0), compact(1.0e6), compact(0.05)),
            ("250k".into(), "1M".into(), "0.05".into())
        );
        assert_eq!(
            (compact(3e-6), compact(-1500.0)),
            ("3e−6".into(), "−1500".into())
        );
    }
}
