// The Python module protomark._core, which takes and returns arrays and releases the GIL while C++
// works.
#include "module.h"

namespace protomark::python {
namespace {

nb::object file_error;

// A path in an error need not be UTF-8.
void raise(PyObject* type, const std::exception& error) {
  const auto text = nb::steal(PyUnicode_DecodeFSDefault(error.what()));
  if (text.is_valid()) PyErr_SetObject(type, text.ptr());
}

void bind_errors(nb::module_& m) {
  file_error = nb::steal(PyErr_NewExceptionWithDoc(
      "protomark.FileError", "A file that cannot be read or written, or is not what it should be.",
      nb::make_tuple(nb::borrow(PyExc_OSError), nb::borrow(PyExc_ValueError)).ptr(), nullptr));
  m.attr("FileError") = file_error;
  nb::register_exception_translator([](const std::exception_ptr& p, void*) {
    try {
      std::rethrow_exception(p);
    } catch (const FileError& error) {
      raise(file_error.ptr(), error);
    } catch (const UnknownLandmark& error) {
      raise(PyExc_KeyError, error);
    } catch (const std::invalid_argument& error) {
      raise(PyExc_ValueError, error);
    }
  });
  // The last reference must be dropped before Python ends.
  nb::module_::import_("atexit").attr("register")(nb::cpp_function([] { file_error.reset(); }));
}

}  // namespace

nb::object from_metadata(const Metadata& metadata) {
  nb::dict texts;
  for (const auto& [name, text] : metadata) texts[nb::str(name.c_str(), name.size())] = text;
  return nb::module_::import_("types").attr("MappingProxyType")(texts);
}

Metadata to_metadata(nb::handle object) {
  // Raises UnicodeEncodeError for surrogates, which are not UTF-8.
  const auto utf8 = [](nb::handle text) {
    const auto bytes = nb::cast<nb::bytes>(text.attr("encode")());
    return std::string(bytes.c_str(), bytes.size());
  };
  Metadata result;
  const nb::object texts = nb::module_::import_("builtins").attr("dict")(object);
  for (const auto& [name, text] : nb::cast<nb::dict>(texts)) {
    if (!nb::isinstance<nb::str>(name) || !nb::isinstance<nb::str>(text)) {
      type_error("metadata: names and texts must be str, not " +
                 std::string(nb::repr(name).c_str()) + ": " + nb::repr(text).c_str());
    }
    result.emplace(utf8(name), utf8(text));
  }
  return result;
}

}  // namespace protomark::python

NB_MODULE(_core, m) {
  using namespace protomark::python;
  m.doc() = "The C++ core of Protomark.";
  bind_errors(m);
  bind_encoder(m);
  bind_sealed_map(m);
  bind_prototype_map(m);
  bind_matching(m);
  bind_hamming(m);
  bind_files(m);
}
