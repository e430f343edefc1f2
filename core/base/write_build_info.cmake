# Writes what core/base/build_info.h declares, if it has changed:
#   cmake -D VERSION=1.2.3 -D SOURCE=tree -D OUTPUT=file -P write_build_info.cmake
# The date is today's, or that of SOURCE_DATE_EPOCH.

# An archive that git made has the commit here.
set(commit "$Format:%h$")
if(commit MATCHES "Format")
  set(commit "")
  find_program(GIT git)
endif()
if(GIT)
  # The tree may lie in one of somebody else's.
  execute_process(COMMAND ${GIT} -C ${SOURCE} rev-parse --show-toplevel
                  OUTPUT_VARIABLE top OUTPUT_STRIP_TRAILING_WHITESPACE
                  ERROR_QUIET)
  file(REAL_PATH ${SOURCE} source)
  if(top STREQUAL source)
    execute_process(COMMAND ${GIT} -C ${SOURCE} describe --always --dirty
                            --abbrev=10 "--exclude=*"
                    OUTPUT_VARIABLE commit OUTPUT_STRIP_TRAILING_WHITESPACE
                    ERROR_QUIET)
  endif()
endif()
if(commit)
  set(commit "commit ${commit}, ")
endif()

string(TIMESTAMP date "%Y-%m-%d" UTC)
# Leaves a file as it is that says the same.
configure_file(${CMAKE_CURRENT_LIST_DIR}/build_info.cc.in ${OUTPUT} @ONLY)
