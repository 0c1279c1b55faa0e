
# Adds the names of scenarios, tags and boards, which come from the files of the project, and of rigs.
_platebench_names() {
    _platebench "$@"
    local word=${COMP_WORDS[COMP_CWORD]} names name
    case ${COMP_WORDS[COMP_CWORD - 1]} in
        --tag | --not-tag)
            names=$("$1" run --list --format json 2>/dev/null |
                sed -n '/^ *"tags": \[$/,/\]/s/^ *"\([^"]*\)",\{0,1\}$/\1/p' | sort -u)
            ;;
        --board)
            names=$("$1" board list --format json 2>/dev/null | sed -n 's/^ *"name": "\([^"]*\)",$/\1/p')
            ;;
        --rig) names=$'@RIGS@' ;;
        -*) return ;;
        *)
            [[ ${COMP_WORDS[1]} == run && $word != -* ]] || return
            names=$("$1" run --list -q 2>/dev/null)
            ;;
    esac
    COMPREPLY=()
    # `compgen -W` would execute `$(...)` in a name.
    while IFS= read -r name; do
        if [[ -n $name && $name == "$word"* ]]; then COMPREPLY+=("$name"); fi
    done <<<"$names"
}

complete -F _platebench_names -o bashdefault -o default platebench
