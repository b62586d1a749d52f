/** What the page uses of preact/hooks, for the type checker alone: the library comes without declarations here. */

export function useState<T>(first: T | (() => T)): [T, (next: T | ((now: T) => T)) => void];
export function useEffect(run: () => void | (() => void), of?: readonly unknown[]): void;
export function useMemo<T>(compute: () => T, of: readonly unknown[]): T;
export function useRef<T>(first: T): { current: T };
