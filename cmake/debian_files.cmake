# Run by CPack between staging and packing: what Debian's policy wants of every package, compressed man pages and a changelog.
find_program(gzip gzip REQUIRED)
file(GLOB documentation "${CPACK_TEMPORARY_DIRECTORY}/*/usr/share/doc/*/copyright")
foreach(copyright IN LISTS documentation)
  cmake_path(GET copyright PARENT_PATH folder)
  cmake_path(GET folder FILENAME package)
  string(TIMESTAMP date "%a, %d %b %Y %H:%M:%S +0000" UTC)
  file(WRITE ${folder}/changelog
    "${package} (${CPACK_PACKAGE_VERSION}) unstable; urgency=medium\n\n  * See CHANGELOG.md among the documentation of the package gp2.\n\n"
    " -- ${CPACK_PACKAGE_CONTACT}  ${date}\n")
endforeach()
file(GLOB pages "${CPACK_TEMPORARY_DIRECTORY}/*/usr/share/man/man1/*.1" "${CPACK_TEMPORARY_DIRECTORY}/*/usr/share/doc/*/changelog")
if(pages)
  execute_process(COMMAND ${gzip} -9nf ${pages} COMMAND_ERROR_IS_FATAL ANY)
endif()
