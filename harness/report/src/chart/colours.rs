//! Defines every colour once, for light and dark. Pages use CSS variables. SVG files contain
//! values, because not every viewer of SVG supports variables.

/// One rule per line, because `document_style` selects lines.
pub(crate) const RULES: &str = include_str!("roles.css");

/// Name, light value and dark value. The series have the palette of Okabe and Ito for colour-blind
/// readers, darkened for light and lightened for dark.
const VALUES: [(&str, &str, &str); 39] = [
    ("page", "#f6f6f3", "#121518"),
    ("card", "#fff", "#1a1e23"),
    ("ink", "#1b1f24", "#e7e9ec"),
    ("muted", "#5b646e", "#9ca6b0"),
    ("hair", "#e2e3df", "#2e343b"),
    ("pass", "#1a7040", "#5bc686"),
    ("fail", "#c0271f", "#ff8177"),
    ("inconclusive", "#855700", "#e5b64c"),
    ("pass-soft", "#e3f2e8", "#16301f"),
    ("fail-soft", "#fbe6e3", "#3b1c1a"),
    ("inconclusive-soft", "#faeed3", "#352a12"),
    ("verdict", "#c0271f", "#ff8177"),
    ("first", "#1f6cb0", "#6db3f2"),
    ("second", "#b4531a", "#f2a06a"),
    ("other", "#767f88", "#98a2ac"),
    ("settling", "#1a7040", "#5bc686"),
    ("golden", "#7a4fb5", "#bd9bf0"),
    ("amber", "#e0a72e", "#c08c1f"),
    ("band", "0.2", "0.3"),
    ("series-0", "#111418", "#f4f6f8"),
    ("series-1", "#b34a00", "#ff9b52"),
    ("series-2", "#1f6cb0", "#6db3f2"),
    ("series-3", "#0b7a5a", "#4fd0a5"),
    ("series-4", "#8a3f8f", "#dd93e0"),
    ("series-5", "#8a6d00", "#e8c63c"),
    ("series-6", "#a3243b", "#ff8594"),
    ("series-7", "#2a6f7f", "#79c9dc"),
    ("series-8", "#5c5c5c", "#b5b5b5"),
    ("series-9", "#4b4fb5", "#a3a7ff"),
    ("radius-0", "#2c6fb5", "#6fb0ee"),
    ("radius-1", "#4f8bc6", "#568fcb"),
    ("radius-2", "#78a8d6", "#4274a8"),
    ("radius-3", "#a0c4e4", "#335b85"),
    ("radius-4", "#c5dcf0", "#284664"),
    ("radius-5", "#e4eef8", "#1f3347"),
    ("radius-6", "#fbe0cf", "#48291d"),
    ("radius-7", "#f4b48f", "#6f3a24"),
    ("radius-8", "#e48256", "#a14f2c"),
    ("radius-9", "#c4502c", "#dd7243"),
];

pub(crate) fn variables() -> String {
    let list = |value: fn(&(&str, &'static str, &'static str)) -> &'static str| {
        VALUES.iter().map(|colour| ["--", colour.0, ":", value(colour), ";"].concat()).collect::<String>()
    };
    format!(
        ":root{{{}color-scheme:light dark}}@media screen and (prefers-color-scheme:dark){{:root{{{}}}}}",
        list(|colour| colour.1),
        list(|colour| colour.2)
    )
}

/// Rules for the classes that occur in `body`, with values in place of variables.
pub(crate) fn document_style(body: &str) -> String {
    let is_needed = |rule: &&str| {
        let class = rule.strip_prefix('.').and_then(|rule| rule.split_whitespace().next());
        class.is_none_or(|class| body.contains(&format!("class=\"{class}\"")))
    };
    let needed: String = RULES.lines().filter(is_needed).collect::<Vec<_>>().join("\n");
    let resolve = |value: fn(&(&str, &'static str, &'static str)) -> &'static str| {
        VALUES
            .iter()
            .fold(needed.clone(), |rules, colour| rules.replace(&format!("var(--{})", colour.0), value(colour)))
    };
    let (light, dark) = (resolve(|colour| colour.1), resolve(|colour| colour.2));
    format!("svg{{color-scheme:light dark}}\n{light}\n@media screen and (prefers-color-scheme:dark){{\n{dark}\n}}")
}
