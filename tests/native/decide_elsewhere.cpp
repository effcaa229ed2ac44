// Decisions of the kernel for another processor: arrays and settings in by a file, arrays out by another one
// (test_native_processors.py writes and reads them).

#include <stdio.h>

#include "kernel.cpp"

static FILE* file;

static void take(void* to, size_t bytes) {
    if (fread(to, 1, bytes, file) != bytes) abort();
}

static int64_t number() {
    int64_t n;
    take(&n, sizeof n);
    return n;
}

int main(int, char** names) {
    file = fopen(names[1], "rb");
    int64_t rows = number(), decisions = number(), count = number();
    Settings settings;
    if (number() != sizeof settings) return 3;
    take(&settings, sizeof settings);
    // Structures that the settings point to, in the order of `described`; each begins with a pointer to its weights if it
    // has any.
    struct {
        const void** pointer;
        int64_t size;
    } structures[] = {{(const void**)&settings.generated, sizeof(Generated)},
                      {(const void**)&settings.human, sizeof(Human)},
                      {(const void**)&settings.faults, sizeof(Faults)},
                      {(const void**)&settings.random, sizeof(Random)},
                      {(const void**)&settings.ends, sizeof(Ends)}};
    for (auto [pointer, size] : structures) {
        int64_t bytes = number(), weights = number();
        *pointer = nullptr;
        if (!bytes) continue;
        if (bytes != size) return 4;
        char* structure = (char*)scratch(bytes);
        take(structure, bytes);
        if (weights) {
            float* packed = (float*)scratch(weights * sizeof(float));
            take(packed, weights * sizeof(float));
            *(float**)structure = packed;
        }
        *pointer = structure;
    }
    char** arrays = (char**)calloc(count, sizeof(char*));
    int64_t* sizes = (int64_t*)calloc(count, sizeof(int64_t));
    for (int64_t k = 0; k < count; k++) {
        sizes[k] = number();
        arrays[k] = (char*)scratch(sizes[k]);
        take(arrays[k], sizes[k]);
    }
    // Inputs and outputs: places in `arrays`; -1 is a null pointer.
    void* pointers[2][128] = {};
    for (int side = 0; side < 2; side++) {
        int64_t names_of_side = number();
        for (int64_t k = 0; k < names_of_side; k++) {
            int64_t place = number();
            pointers[side][k] = place < 0 ? nullptr : arrays[place];
        }
    }
    for (int64_t k = 0; k < decisions; k++)
        if (int failed = ganlane_decide(&settings, (Inputs*)pointers[0], (Outputs*)pointers[1], 0, rows)) return failed;
    file = fopen(names[2], "wb");
    for (int64_t k = 0; k < count; k++) fwrite(arrays[k], 1, sizes[k], file);
    return fclose(file);
}
