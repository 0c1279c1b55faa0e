use crate::shipped_code;
use platebench_experiments::mutation::mutants::{
    CodeMutant, Disassembler, MutantFilter, MutationOperator, all_mutants,
};
use platebench_test_kit::skip_without;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::process::Command;

const OBJDUMP: &str = "arm-none-eabi-objdump";
/// Bytes of an instruction with four `NOP` after it, which an `IT` may make conditional.
const SLOT: usize = 12;

fn objdump(codes: &[&[u8]]) -> Vec<(String, String)> {
    let mut image = Vec::new();
    for code in codes {
        image.extend_from_slice(code);
        (code.len()..SLOT).step_by(2).for_each(|_| image.extend(0xBF00_u16.to_le_bytes()));
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("code.bin");
    fs::write(&path, image).unwrap();
    let mut command = Command::new(OBJDUMP);
    let output = command.args(["-D", "-b", "binary", "-m", "arm", "-M", "force-thumb"]).arg(&path).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let instructions: BTreeMap<usize, (String, String)> = text
        .lines()
        .filter_map(|line| {
            let (address, rest) = line.trim().split_once(":\t")?;
            let mut fields = rest.split('\t').skip(1);
            let mnemonic = fields.next()?.trim().to_owned();
            let operands = fields.next().unwrap_or_default().split(['@', ';', '<']).next()?.trim().to_owned();
            Some((usize::from_str_radix(address, 16).ok()?, (mnemonic, operands)))
        })
        .collect();
    (0..codes.len()).map(|index| instructions[&(index * SLOT)].clone()).collect()
}

/// Removes the suffix of the width: `.n` or `.w`.
fn plain(mnemonic: &str) -> &str {
    mnemonic.trim_end_matches(".n").trim_end_matches(".w")
}

fn is_swap(before: &str, after: &str) -> bool {
    const SWAPS: [(&str, &str); 11] = [
        ("vadd.f32", "vsub.f32"),
        ("vmul.f32", "vdiv.f32"),
        ("vmla.f32", "vmls.f32"),
        ("vnmla.f32", "vnmls.f32"),
        ("vfma.f32", "vfms.f32"),
        ("vfnma.f32", "vfnms.f32"),
        ("add", "sub"),
        ("adds", "subs"),
        ("addw", "subw"),
        ("adc", "sbc"),
        ("adcs", "sbcs"),
    ];
    const ONE_WAY: [(&str, &str); 3] = [("vneg.f32", "vmov.f32"), ("vabs.f32", "vmov.f32"), ("vnmul.f32", "vmul.f32")];
    let pair = (plain(before), plain(after));
    SWAPS.iter().any(|&(one, other)| pair == (one, other) || pair == (other, one)) || ONE_WAY.contains(&pair)
}

/// Returns the condition, for example `eq` for `beq` and for `it eq`.
fn condition<'a>(mnemonic: &'a str, operands: &'a str) -> &'a str {
    if mnemonic.starts_with("it") { operands } else { plain(mnemonic).trim_start_matches('b') }
}

fn are_negated(before: &str, after: &str) -> bool {
    let pairs = [("eq", "ne"), ("cs", "cc"), ("mi", "pl"), ("vs", "vc"), ("hi", "ls"), ("ge", "lt"), ("gt", "le")];
    pairs.iter().any(|&(one, other)| (before, after) == (one, other) || (before, after) == (other, one))
}

fn is_expected(operator: MutationOperator, before: &(String, String), after: &(String, String)) -> bool {
    let (one, other) = (plain(&before.0), plain(&after.0));
    match operator {
        MutationOperator::Arithmetic => is_swap(one, other) && before.1 == after.1,
        MutationOperator::Condition if one.starts_with("cb") => {
            one != other && other.starts_with("cb") && before.1 == after.1
        }
        MutationOperator::Condition => {
            let same = if one.starts_with("it") { one == other } else { before.1 == after.1 };
            same && are_negated(condition(one, &before.1), condition(other, &after.1))
        }
        MutationOperator::Boundary => {
            let pair = [condition(one, &before.1), condition(other, &after.1)].into_iter().collect::<BTreeSet<_>>();
            let pairs = [["ge", "gt"], ["le", "lt"], ["cs", "hi"], ["cc", "ls"], ["ls", "mi"], ["hi", "pl"]];
            let same = if one.starts_with("it") { one == other } else { before.1 == after.1 };
            same && pairs.iter().any(|expected| pair == expected.iter().copied().collect())
        }
        MutationOperator::RemovedCall => one.starts_with("bl") && other == "nop",
        MutationOperator::RemovedStore => (one.starts_with("str") || one.starts_with("vstr")) && other == "nop",
        MutationOperator::RemovedSaturation => {
            let removed = ["mov", "movs", "vmov.f32", "vldr"].contains(&one) && other == "nop";
            removed || one.ends_with("sat") && other == "mov"
        }
        MutationOperator::Constant => one == other && before.1 != after.1,
    }
}

fn shipped_mutants() -> Vec<CodeMutant> {
    let (map, symbols) = shipped_code();
    let all = MutantFilter { functions: vec![String::new()], files: Vec::new() };
    all_mutants(&map, &symbols, &Disassembler::new().unwrap(), &all, &BTreeMap::new())
}

#[test]
fn mutants_are_what_binutils_reads() {
    if Command::new(OBJDUMP).arg("--version").output().is_err() {
        return skip_without(OBJDUMP);
    }
    let mutants = shipped_mutants();
    let code: Vec<_> = mutants.iter().filter(|mutant| mutant.address == mutant.instruction).collect();
    let before = objdump(&code.iter().map(|mutant| &*mutant.original).collect::<Vec<_>>());
    let after = objdump(&code.iter().map(|mutant| &*mutant.bytes).collect::<Vec<_>>());
    let wrong: Vec<String> = code
        .iter()
        .zip(before.iter().zip(&after))
        .filter(|(mutant, (before, after))| !is_expected(mutant.operator, before, after))
        .map(|(mutant, texts)| format!("{:#x} {}: {texts:?}", mutant.instruction, mutant.operator))
        .collect();
    assert!(wrong.is_empty(), "{} of {}: {}", wrong.len(), code.len(), wrong.join("\n"));
    let operators: BTreeSet<&str> = code.iter().map(|mutant| mutant.operator.name()).collect();
    assert_eq!(operators.len(), MutationOperator::ALL.len(), "{operators:?}");
    assert!(code.len() > 1_000, "{}", code.len());
}

#[test]
fn constants_in_the_literal_pool_change_their_value() {
    let mutants = shipped_mutants();
    let pool: Vec<_> = mutants.iter().filter(|mutant| mutant.address != mutant.instruction).collect();
    assert!(pool.len() > 100, "{}", pool.len());
    for mutant in pool {
        assert_eq!((mutant.original.len(), mutant.bytes.len()), (4, 4));
        assert_ne!(mutant.original, mutant.bytes);
        assert!(mutant.before.contains("ldr"), "{}", mutant.before);
    }
}

fn disassembly() -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("firmware.elf");
    fs::write(&path, platebench_rig::BUILT_IN_IMAGE).unwrap();
    let output = Command::new(OBJDUMP).arg("-d").arg(&path).output().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn no_half_of_an_address_changes() {
    if Command::new(OBJDUMP).arg("--version").output().is_err() {
        return skip_without(OBJDUMP);
    }
    let text = disassembly();
    let lines: Vec<&str> = text.lines().collect();
    // `movw r1, #36052` and `movt r1, #2048` together load 0x08008cd4, an address in flash.
    let value = |operand: &str| operand.split_whitespace().next()?.parse::<u32>().ok();
    let operands = |line: &str, name: &str| {
        let (register, immediate) = line.split_once(name)?.1.trim().split_once(", #")?;
        Some((register.to_owned(), value(immediate)?))
    };
    let halves = lines.iter().enumerate().filter_map(|(index, line)| {
        let (register, _) = operands(line, "\tmovw")?;
        let next = lines[index + 1..].iter().take(5).filter_map(|next| operands(next, "\tmovt"));
        let high = next.filter(|(other, _)| *other == register).map(|(_, high)| high).next()?;
        let address = u32::from_str_radix(line.trim().split_once(":\t")?.0, 16).ok()?;
        [0x0800, 0x2000, 0x4002].contains(&high).then_some(address)
    });
    let halves: BTreeSet<u32> = halves.collect();
    assert!(halves.len() > 20, "{halves:?}");
    let constants = shipped_mutants().into_iter().filter(|mutant| mutant.operator == MutationOperator::Constant);
    let (moves, others): (Vec<_>, Vec<_>) = constants.partition(|mutant| mutant.before.starts_with("movw"));
    assert!(!moves.is_empty() && others.len() > 100);
    let changed: Vec<_> = moves.iter().filter(|mutant| halves.contains(&mutant.instruction)).collect();
    assert!(changed.is_empty(), "{changed:?}");
}

#[test]
fn splits_code_where_binutils_does() {
    if Command::new(OBJDUMP).arg("--version").output().is_err() {
        return skip_without(OBJDUMP);
    }
    let text = disassembly();
    let starts: BTreeSet<u32> = text
        .lines()
        .filter(|line| !line.contains("\t.word\t") && !line.contains("\t.short\t") && !line.contains("\t.byte\t"))
        .filter_map(|line| u32::from_str_radix(line.trim().split_once(":\t")?.0, 16).ok())
        .collect();
    let (map, _) = shipped_code();
    let other: Vec<String> =
        map.instructions.keys().filter(|at| !starts.contains(at)).map(|at| format!("{at:#x}")).collect();
    assert!(other.is_empty(), "{other:?}");
    assert!(map.instructions.len() > 5_000, "{}", map.instructions.len());
}
