# Writes the manual page of a program, which is its help as it stands:
#   cmake -D NAME=revisitd -D ABOUT=SENTENCE -D SYNOPSIS=OPTIONS
#     -D PROGRAM=COMMAND -D OUTPUT=revisitd.1 -P write_man_page.cmake
foreach(flag IN ITEMS help version)
  execute_process(COMMAND ${PROGRAM} --${flag} OUTPUT_VARIABLE ${flag}
                  COMMAND_ERROR_IS_FATAL ANY)
endforeach()
# CMake splits at semicolons, and takes brackets for quotes: neither is parsed in
# a quoted string.
string(REPLACE "\\" "\\e" help "${help}")
string(REPLACE "-" "\\-" help "${help}")
string(REPLACE "'" "\\(aq" help "${help}")
string(REPLACE "\n." "\n\\&." help "${help}")
string(REGEX REPLACE " *\n" "\n" help "${help}")
string(REGEX MATCH "[0-9]+\\.[0-9]+\\.[0-9]+" number "${version}")
string(REGEX MATCH "[0-9]+-[0-9]+-[0-9]+" date "${version}")
string(REPLACE "-" "\\-" name "${NAME}")
string(REPLACE "-" "\\-" about "${ABOUT}")
string(TOUPPER "${name}" title)
file(WRITE ${OUTPUT} ".TH ${title} 1 \"${date}\" \"revisit ${number}\" \"User Commands\"
.SH NAME
${name} \\- ${about}
.SH SYNOPSIS
.B ${name} ${SYNOPSIS}
.SH DESCRIPTION
.nf
${help}.fi
.SH SEE ALSO
.BR revisit (1)
")
